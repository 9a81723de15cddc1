"""`ipe-bench posterior`: what the readings of a few trials really say, beside what estimators make of them."""

from __future__ import annotations

from collections.abc import Sequence

from ipe_bench.api import posterior
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, show
from ipe_bench.cli.single import OF_FILES, OF_MANY_TRIALS, single
from ipe_bench.runs.provenance import describe
from ipe_bench.runs.run import validate

_TRIALS = 3
_MOST_TRIALS = 100


def main(arguments: Sequence[str], particles: int) -> int:
    """Samples, prints a table and writes files; exit code 1 where the populations of a trial do not agree."""
    asked = single("posterior", arguments, run=(*OF_MANY_TRIALS, "figures"), estimate=OF_FILES)
    job, name = asked.spec, asked.measurement
    trials = job.count if "trials" in asked.words.keys else _TRIALS
    if trials > _MOST_TRIALS:
        raise UserError(f"trials={trials}: each takes up to a minute; give at most {_MOST_TRIALS}")
    if job.scenario.noise.real:
        raise UserError("noise=certified: has no prior to begin with; choose another noise and an error_scale")
    validate([job.scenario], job.estimators, trials)

    from ipe_bench.report.posteriors import NAME, contents, write_posteriors
    from ipe_bench.report.writer import claim

    command = {
        "scenario": describe(job.scenario),
        "estimators": {label: describe(estimator) for label, estimator in job.estimators.items()},
        "trials": trials,
        "particles": particles,
    }
    folder = claim(asked.folder, NAME, command, elsewhere=not asked.named)
    found = posterior(job.scenario, job.estimators, trials, particles=particles)
    scenario = f"{name}, {job.scenario.noise.name}, error scale {job.scenario.error_scale:g}"
    files = write_posteriors(folder, name, scenario, job.scenario.measurement, found, command)
    show(contents(scenario, found))
    console().print(f"\nIn {folder}: {', '.join(path.name for path in files)}", markup=False, soft_wrap=True)
    return 0 if all(one.posterior.settled for one in found) else 1
