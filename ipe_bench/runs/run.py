"""The run of a bench: what is asked for is checked, what is missing is computed and stored, and all of it recorded.

When a run has enough trials for a precision is left to `statistics.stopping`.
"""

from __future__ import annotations

import datetime
import functools
import platform
import subprocess
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ipe_bench.basics.errors import StorageError, UserError
from ipe_bench.basics.machine import cores, library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.problem import Problem
from ipe_bench.measurements.repeatable import require_repeatable
from ipe_bench.runs.execution import Execution, Serial
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.provenance import describe, digest, fingerprint
from ipe_bench.runs.results import Results
from ipe_bench.runs.schedule import RunLog, Watcher, block_size_for, plan, run_task, run_tasks
from ipe_bench.runs.store import ResultKey, Store, compact
from ipe_bench.trials.bounds import linear_bound
from ipe_bench.trials.scenario import Scenario

TRIALS = 1000
"""Number of trials if neither a number nor a precision is given."""
MOST_TRIALS = 100_000
"""Largest number of trials with a precision, if no number is given."""
MOST_BLOCKS = 1_000_000
LARGEST = 1e100
"""Bound on scales: the squares of larger numbers, and of those below its inverse, are not representable."""
_FEW = 4


def compute(
    scenarios: Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int,
    output: Path | str,
    *,
    execution: Execution | None = None,
    block_size: int | None = None,
    watch: Watcher | None = None,
    record_as: str | None = None,
    further: Mapping[str, Any] | None = None,
    command: str | None = None,
) -> tuple[str, ...]:
    """Computes and stores what is missing under `output`; returns the messages of what failed.

    Trials are computed `block_size` at once, which changes no number: where it is None, so many as are quickest.

    The run is recorded under a new name, or under `record_as`, in place of what is there; with `further` facts, and the
    `command` as it was typed.

    Raises:
        UserError: what was asked for cannot be computed, or the folder cannot be written to; nothing is computed then.
        StorageError: nothing can be stored any more.
    """
    # What is stored of a scenario shows that its numbers can be computed with, without drawing any.
    stored = [any(Path(output).glob(f"trials/{ResultKey(scenario).key}-*.parquet")) for scenario in scenarios]
    untried = [scenario for scenario, known in zip(scenarios, stored, strict=True) if not known]
    execution = execution or Serial()
    block_size = block_size_for(trials) if block_size is None else block_size
    if block_size > 0:
        # Workers start while this process looks at what is asked for.
        execution.warm_up(run_task, len(untried) * -(-trials // block_size))
    validate(scenarios, estimators, trials, block_size, untried=untried)
    # Absolute: workers may have another working folder.
    store = Store(Path(output).absolute())
    store.prepare()
    cells = [result_keys(scenario, estimators) for scenario in scenarios]
    results = Results.read([store.directory], keys={cell.key for part in cells for cell in part})
    aside = results.set_aside()
    tasks = [task for part in cells for task in plan(store.directory, part, results, trials, block_size)]
    execution.warm_up(run_task, len(tasks))
    record = _record(scenarios, estimators, trials) | dict(further or {})
    known = None if tasks or aside else store.same_run(record)
    typed = {"command": command, "blocks": len(tasks)}
    identifier = known or _write_record(store, record | typed, record_as or new_name())
    with RunLog(store.directory / "log" / f"{identifier}.log") as log:
        for line in aside:
            log.warning(line)
        failures = run_tasks(tasks, execution, store, watch or (lambda progress: None), log)
        store.require()
        gone, hindrances = compact(store.directory, {cell.key for part in cells for cell in part}, execution)
        for line in [f"{gone} small files were merged into larger ones"] * bool(gone) + hindrances:
            log.info(line)
    if not (store.runs / f"{identifier}.json").is_file():
        raise StorageError(f"{store.directory}: lost the record of this run; the same command computes what is missing")
    return failures


def validate(
    scenarios: Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int,
    block_size: int | None = None,
    *,
    untried: Sequence[Scenario] | None = None,
    estimating: bool = False,
) -> None:
    """Raises one UserError with everything that stands in the way of this run, or of `estimating` from real readings.

    Trials are drawn of the scenarios `untried` (all where it is None), to see whether numbers hold what is asked for;
    none are where readings are real.
    """
    mistakes = []
    if trials < 1:
        mistakes.append(f"trials={trials}: give a whole number above 0")
    size = block_size_for(trials) if block_size is None else block_size
    if size < 1:
        mistakes.append(f"block_size={size}: give a whole number above 0")
    elif trials > MOST_BLOCKS * size:
        mistakes.append(f"trials={trials}: are more than {MOST_BLOCKS} blocks of block_size={size}")
    if not scenarios:
        mistakes.append("there is no scenario; give at least one")
    if TRUTH in estimators:
        mistakes.append(f"estimators.{TRUTH}: is what the truth itself is stored under; choose another label")
    if not estimators:
        mistakes.append("there is no estimator; choose with solver= and baseline=")
    for scenario in scenarios:
        if scenario.noise.estimated and not estimating:
            mistakes.append("noise=unknown: has no level to simulate with; choose another noise, or use `estimate`")
        if scenario.noise.real and trials != 1:
            mistakes.append(f"trials={trials}: certified readings are one trial; set trials=1")
        if not estimating and not scenario.noise.estimated and (untried is None or scenario in untried):
            mistakes += _beyond_numbers(scenario)
            require_repeatable(scenario.measurement)
            require_repeatable(scenario.simulator)
        mistakes += unmet_needs(scenario.problem, estimators)
    if mistakes:
        raise UserError("; ".join(dict.fromkeys(mistakes)))


def unmet_needs(problem: Problem, estimators: Mapping[str, Estimator]) -> list[str]:
    """A line for each thing that an estimator needs and the problem does not have."""
    return [
        f"estimators.{label}: needs {need}, which measurement={problem.measurement.name} does not have; leave it out"
        for label, estimator in estimators.items()
        for need in estimator.missing(problem)
    ]


def _beyond_numbers(scenario: Scenario) -> Iterator[str]:
    """Scales at which every statistic would be infinite or 0, as no number holds their squares."""
    if scenario.error_scale > LARGEST:
        yield f"error_scale={scenario.error_scale:g}: its square overflows; give a number up to {LARGEST:g}"
        return
    model = scenario.measurement
    with np.errstate(all="ignore"):
        bound = linear_bound(scenario.problem)
        try:
            few = scenario.draw(0, 1 if scenario.noise.real else _FEW)
        except UserError:
            raise
        except Exception:  # what cannot be drawn is a failure of its blocks, and told of there
            return
    if not scenario.noise.real and not np.isfinite(few.z).all(axis=1).any():
        reason = scenario.simulator.hindrance(few.x[0])
        yield f"measurement={model.name}: none of the first {_FEW} trials has readings: {reason}; choose smaller scales"
        return
    for parameter, deviation in zip(model.parameters, bound, strict=True):
        if scenario.noise.real and np.isnan(deviation):
            return  # J lacks rank at the start, or is not finite there: that is a hard start, and no mistake
        if not 1 / LARGEST <= deviation <= LARGEST and deviation != 0:
            yield (
                f"noise={scenario.noise.name}: {parameter.name} has a linear bound of {deviation:g} of its size, "
                "whose square is beyond numbers; choose another scale of the noise"
            )
            return


def result_keys(scenario: Scenario, estimators: Mapping[str, Estimator]) -> list[ResultKey]:
    """What a run stores of one scenario: its truth, and each estimator."""
    return [ResultKey(scenario), *(ResultKey(scenario, label, estimator) for label, estimator in estimators.items())]


def new_name() -> str:
    """A name for the record of a run."""
    return f"{datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:8]}"


def _write_record(store: Store, record: Mapping[str, Any], identifier: str) -> str:
    """States what is going to be computed, so that what is missing later is known to be missing; returns its name."""
    store.write_run(identifier, {"started": _now(), **record})
    return identifier


def record_refusal(
    output: Path | str,
    job: str,
    reason: str,
    scenario: Scenario | None = None,
    estimators: Mapping[str, Estimator] = MappingProxyType({}),
    trials: int = 1,
) -> None:
    """Notes in a folder that a job of a sweep was asked for and refused, if the folder holds results.

    `job` tells it from the others; `accept` takes the note back. Scenario and estimators are given if the job came to
    them.
    """
    store = Store(Path(output))
    if store.trials.is_dir():
        store.prepare()
        record = {"started": _now(), **_record([scenario] if scenario else [], estimators, trials)}
        store.write_run(_refusal(job), {**record, "job": job, "refused": reason})


def accept(output: Path | str, job: str) -> None:
    """Takes back what `record_refusal` noted of a job."""
    (Store(Path(output)).runs / f"{_refusal(job)}.json").unlink(missing_ok=True)


def _refusal(job: str) -> str:
    return f"refused-{digest(job)}"


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds")


def _record(scenarios: Sequence[Scenario], estimators: Mapping[str, Estimator], trials: int) -> dict[str, Any]:
    cells = [cell for scenario in scenarios for cell in result_keys(scenario, estimators)]
    return {
        "trials": trials,
        "scenarios": [describe(s) for s in scenarios],
        "estimators": {label: describe(e) for label, e in estimators.items()},
        "cells": [{"key": c.key, "identity_key": c.identity_key, "names": c.names} for c in cells],
        "libraries": library_versions(),
        "machine": {"host": platform.node(), "system": platform.platform(), "cores": cores()},
        "git_commit": _git_commit(Path.cwd()),
        **fingerprint([*scenarios, *estimators.values()]),
    }


@functools.cache
def _git_commit(folder: Path) -> str | None:
    """The commit of the folder, where it is in a repository; asked once per process, as a sweep records it per job."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
