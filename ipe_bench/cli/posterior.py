"""`ipe-bench posterior`: what the readings of a few trials really say, beside what estimators make of them."""

from __future__ import annotations

from collections.abc import Sequence

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, show
from ipe_bench.cli.single import NOT_OF_ONE_SCENARIO, compose_single, first_of
from ipe_bench.runs.provenance import describe
from ipe_bench.runs.run import validate
from ipe_bench.trials.posterior import reference

_TRIALS = 3
_MOST_TRIALS = 100


def main(arguments: Sequence[str], particles: int) -> int:
    """Samples, prints a table and writes files; exit code 1 where the populations of a trial do not agree."""
    single = compose_single("posterior", arguments, _refuse_keys_without_use)
    job, name = single.job, single.measurement
    trials = job.count if any(w.lstrip("+").startswith("trials=") for w in single.words) else _TRIALS
    if trials > _MOST_TRIALS:
        raise UserError(f"trials={trials}: each takes up to a minute; give at most {_MOST_TRIALS}")
    if job.scenario.noise.real:
        raise UserError("noise=certified: has no prior to begin with; choose another noise and an error_scale")
    validate([job.scenario], job.estimators, trials)

    from ipe_bench.report.folders import claim
    from ipe_bench.report.posteriors import RESULT, contents, write_posteriors

    command = {
        "scenario": describe(job.scenario),
        "estimators": {label: describe(estimator) for label, estimator in job.estimators.items()},
        "trials": trials,
        "particles": particles,
    }
    files_ours = [f"corner_{trial}.{kind}" for trial in range(trials) for kind in ("png", "pdf")]
    folder = claim(single.folder, command, elsewhere=not single.named, result=RESULT, files=files_ours)
    found = [reference(job.scenario, job.estimators, trial, particles) for trial in range(trials)]
    files = write_posteriors(folder, job.scenario.measurement, found, command, {"measurement": name})
    scenario = f"{name}, {job.scenario.noise.name}, error scale {job.scenario.error_scale:g}"
    show(contents(scenario, found))
    console().print(f"\nIn {folder}: {', '.join(path.name for path in files)}", markup=False, soft_wrap=True)
    return 0 if all(one.posterior.settled for one in found) else 1


def _refuse_keys_without_use(words: Sequence[str]) -> None:
    key = first_of(NOT_OF_ONE_SCENARIO, words)
    if key is not None:
        raise UserError(f"{key}: is for other commands, and nothing in a posterior; leave it out")
