"""`ipe-bench posterior`: what the readings of a few trials really say, beside what estimators make of them."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ipe_bench.api import posterior
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import show
from ipe_bench.cli.single import OF_FILES, OF_MANY_TRIALS, say_files, single
from ipe_bench.runs.provenance import describe
from ipe_bench.runs.run import validate

_TRIALS, _MOST_TRIALS = 3, 100


def main(arguments: Sequence[str], particles: int) -> int:
    """Samples, prints a table and writes files; exit code 1 where the populations of a trial do not agree."""
    asked = single("posterior", arguments, run=(*OF_MANY_TRIALS, "figures"), estimate=OF_FILES)
    job, name, scenario = asked.spec, asked.measurement, asked.spec.scenario
    trials = job.count if "trials" in asked.words.keys else _TRIALS
    if trials > _MOST_TRIALS:
        raise UserError(f"trials={trials}: each takes up to a minute; give at most {_MOST_TRIALS}")
    if scenario.noise.real:
        raise UserError("noise=certified: has no prior to begin with; choose another noise and an error_scale")
    validate([scenario], job.estimators, trials)

    from ipe_bench.report.questions import posterior_parts, write_posteriors

    command = {
        "scenario": describe(scenario),
        "estimators": {label: describe(estimator) for label, estimator in job.estimators.items()},
        "trials": trials,
        "particles": particles,
    }
    folder = asked.folder("posterior", command)

    def tell(trial: int) -> None:
        print(f"{name}: trial {trial + 1} of {trials}", file=sys.stderr, flush=True)

    found = posterior(scenario, job.estimators, trials, particles=particles, watch=tell)
    title = f"{name}, {scenario.noise.name}, error scale {scenario.error_scale:g}"
    files = write_posteriors(folder, name, title, scenario.measurement, found)
    show(posterior_parts(title, found))
    say_files(files)
    return 0 if all(one.posterior.settled for one in found) else 1
