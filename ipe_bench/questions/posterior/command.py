"""Describes the command `ipe-bench posterior`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.questions.question import Answered, Asked, Question

_TRIALS = 3
"""Number of trials unless given."""
_MOST_TRIALS = 100

_MORE = """
  ipe-bench posterior oxygen.py oxygen.csv       with the noise of your readings
  ipe-bench posterior error_scale=300 "solver=[newton]" "baseline=[ekf]"
  ipe-bench posterior measurement=ranging noise=gaussian noise.deviation=0.1 \\
      error_scale=100 trials=1

Sample the posterior of the first trials of a scenario (trials=3 by default) by
sequential Monte Carlo, without linearisation: particles move from the prior to
the posterior as the likelihood is tempered. Compare the estimate and covariance
of each estimator with it. A trial takes seconds to a minute.

particles=NUMBER    particles of each of two populations (1000)
output=DIR          folder of the files
"""


def answer(asked: Asked, particles: int = 1000) -> Answered:
    """Returns the table of the posteriors, whose files are written; exit code 1 where populations
    do not agree."""
    from ipe_bench.questions.posterior.answer import posterior_parts, sampled, write_posteriors
    from ipe_bench.runs.provenance import describe
    from ipe_bench.runs.run import validate

    name = asked.title
    scenario = asked.scenario
    trials = _TRIALS if asked.trials is None else asked.trials
    if trials > _MOST_TRIALS:
        raise UserError(f"trials={trials}: each takes up to a minute; give at most {_MOST_TRIALS}")
    if scenario.noise.real:
        raise UserError(
            "noise=certified: has no prior to begin with; choose another noise and an error_scale"
        )
    validate([scenario], asked.estimators, trials)
    identity = {
        "scenario": describe(scenario),
        "estimators": {label: describe(estimator) for label, estimator in asked.estimators.items()},
        "trials": trials,
        "particles": particles,
    }

    def tell(trial: int) -> None:
        print(f"{name}: trial {trial + 1} of {trials}", file=sys.stderr, flush=True)

    title = f"{name}, {scenario.noise.name}, error scale {scenario.error_scale:g}"
    with asked.folder("posterior", identity, ()) as folder:
        found = sampled(scenario, asked.estimators, trials, particles, tell)
        files = write_posteriors(folder, name, title, scenario.measurement, found)
    settled = all(one.posterior.settled for one in found)
    return Answered(posterior_parts(title, found), 0 if settled else 1, files=files)


def options() -> Mapping[str, Any]:
    """Returns the types of its options."""
    from ipe_bench.basics.options import Count

    return {"particles": Count}


QUESTION = Question(
    codes="0 the populations of particles agree; 1 they differ in some trial",
    more=_MORE,
    argument=("KEY=VALUE", "any key of `ipe-bench run`"),
    run=answer,
    options=options,
)
