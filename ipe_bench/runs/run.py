"""The run of a bench: what is asked for is checked, what is missing is computed and stored, and all
of it recorded."""

from __future__ import annotations

import datetime
import functools
import logging
import platform
import subprocess
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.definitions import pinned
from ipe_bench.basics.errors import StorageError, UserError
from ipe_bench.basics.linalg import finite
from ipe_bench.basics.machine import cores, library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.problem import require_function
from ipe_bench.noise.unknown import NO_LEVEL
from ipe_bench.runs.execution import Execution, Serial
from ipe_bench.runs.parts import TRUTH, Unusable
from ipe_bench.runs.provenance import describe, digest, fingerprint
from ipe_bench.runs.results import Results
from ipe_bench.runs.schedule import Task, Watcher, block_size_for, plan, run_tasks
from ipe_bench.runs.store import ResultKey, Store
from ipe_bench.states.trackers import Tracker
from ipe_bench.trials.paths import AnyScenario, StateScenario
from ipe_bench.trials.scenario import Scenario

log = logging.getLogger(__name__)

MOST_BLOCKS = 1_000_000
LARGEST = 1e100
"""Bound on scales: the squares of larger numbers, and of those below its inverse, are not
representable."""
_FEW = 4


def compute(
    scenarios: Sequence[AnyScenario],
    estimators: Mapping[str, Any],
    trials: int,
    output: Path | str,
    *,
    execution: Execution | None = None,
    block_size: int | None = None,
    watch: Watcher | None = None,
    record_as: str | None = None,
    further: Mapping[str, Any] | None = None,
    command: str | None = None,
    known: Results | None = None,
) -> tuple[str, ...]:
    """Computes and stores what is missing under `output`, in blocks of `block_size` trials, which
    changes no number; returns the messages of what failed.

    The run is recorded, unless nothing is missing and the same was asked for before: under a new
    name, or under `record_as`, in place of what is there; with `further` facts, and the `command`
    as it was typed. `known` is what was read of these cells before, if nothing was added to them
    since: a sweep reads its folder once.

    Raises:
        UserError: it is impossible; nothing was computed.
        StorageError: nothing can be stored any more.
    """
    # Absolute: workers may have another working folder.
    store = Store(Path(output).absolute())
    scenarios = pinned(list(scenarios))
    estimators = {label: pinned(one) for label, one in estimators.items()}
    # What is stored of a scenario shows that its numbers can be computed with, without drawing any.
    keys = [ResultKey(scenario).key for scenario in scenarios]
    stored = {part.key for part in store.parts(keys)} if known is None else known.stored
    untried = [scenario for scenario, key in zip(scenarios, keys, strict=True) if key not in stored]
    block_size = block_size_for(trials) if block_size is None else block_size
    validate(scenarios, estimators, trials, block_size, untried=untried)
    store.prepare()
    of_scenarios = [result_keys(scenario, estimators) for scenario in scenarios]
    cells = [cell for several in of_scenarios for cell in several]
    results = known or Results.read([store.directory], keys={cell.key for cell in cells})
    aside = results.set_aside()
    tasks: list[Task] = []
    for several in of_scenarios:
        tasks += plan(store.directory, several, results, trials, block_size)
    record = None
    if tasks or aside or not results.announces(cells, trials):
        facts = _record(scenarios, estimators, trials)
        facts |= further or {}
        facts |= {"command": command, "blocks": len(tasks)}
        record = store.write_run(record_as or new_name(), facts)
    for line in aside:
        log.warning(line)
    failures = run_tasks(tasks, execution or Serial(), store, watch or (lambda progress: None))
    touched = {cell.key for task in tasks for cell in task.cells}
    for key in {cell.key for cell in cells}:
        if key not in touched and len(results.stored[key].parts) == 1:
            continue
        try:
            store.merge(key)
        except (Unusable, StorageError) as error:
            log.warning(f"{store.directory}: the files of {key} stay as they are: {error}")
    if record is not None and not record.is_file():
        raise StorageError(
            f"{store.directory}: lost the record of this run; the same command computes what is"
            " missing"
        )
    return failures


def validate(
    scenarios: Sequence[AnyScenario],
    estimators: Mapping[str, Any],
    trials: int,
    block_size: int | None = None,
    *,
    untried: Sequence[AnyScenario] | None = None,
) -> None:
    """Raises one UserError with everything that stands in the way of this run; trials are drawn of
    the scenarios `untried` (all if None), to see whether numbers hold what is asked for."""
    size = block_size_for(trials) if block_size is None else block_size
    mistakes = []
    for name, value in {"trials": trials, "block_size": size}.items():
        if value < 1:
            mistakes.append(f"{name}={value}: give a whole number above 0")
    if trials > MOST_BLOCKS * size >= MOST_BLOCKS:
        mistakes.append(f"trials={trials}: are more than {MOST_BLOCKS} blocks of block_size={size}")
    if not scenarios:
        mistakes.append("there is no scenario; give at least one")
    if TRUTH in estimators:
        mistakes.append(
            f"estimators.{TRUTH}: is what the truth itself is stored under; choose another label"
        )
    if not estimators:
        mistakes.append(
            "there is no estimator; choose with solver= and baseline=, or with tracker= for a"
            " state model"
        )
    for scenario in scenarios:
        if scenario.noise.real and trials != 1:
            mistakes.append(f"trials={trials}: certified readings are one trial; set trials=1")
        if isinstance(scenario, StateScenario):
            what = "estimates constants; a state model takes trackers"
            others = _others(estimators, Tracker, what)
            mistakes += others or _with_trackers(scenario, estimators, untried)
        else:
            what = "tracks states that move; a measurement model takes estimators"
            others = _others(estimators, Estimator, what)
            mistakes += others or _with_estimators(scenario, estimators, untried)
    if mistakes:
        raise UserError("; ".join(dict.fromkeys(mistakes)))


def _others(estimators: Mapping[str, Any], kind: type, what: str) -> list[str]:
    """Refuses what is not of the kind that a scenario takes."""
    labels = [label for label, one in estimators.items() if not isinstance(one, kind)]
    return [f"estimators.{label}: {what}" for label in labels]


def _with_trackers(
    scenario: StateScenario, trackers: Mapping[str, Any], untried: Sequence[AnyScenario] | None
) -> list[str]:
    found = {label: tracker.hindrance(scenario.assumed) for label, tracker in trackers.items()}
    mistakes = [f"trackers.{label}: {why}" for label, why in found.items() if why]
    if scenario.assumed.degrees_of_freedom:
        mistakes += [
            f"trackers.{label}: has a gate, which readings of Student's t need not; remove one"
            for label, tracker in trackers.items()
            if tracker.gate is not None
        ]
    if not scenario.noise.real and (untried is None or scenario in untried):
        mistakes += _without_paths(scenario)
    return mistakes


def _without_paths(scenario: StateScenario) -> Iterator[str]:
    with np.errstate(all="ignore"):
        try:
            few = scenario.draw(0, _FEW)
        except Exception:  # what cannot be drawn is a failure of its blocks, and told of there
            return
    if not finite(few.x).any():
        yield (
            f"state_model={scenario.model.name}: none of the first {_FEW} paths has finite states;"
            " fix the transition, or choose another start or narrower spreads"
        )
    elif not np.isfinite(few.z).any():
        yield (
            f"state_model={scenario.model.name}: none of the first {_FEW} paths has a finite"
            " reading; mend the readings, or choose another start or narrower spreads"
        )


def _with_estimators(
    scenario: Scenario, estimators: Mapping[str, Any], untried: Sequence[AnyScenario] | None
) -> list[str]:
    mistakes = []
    model = scenario.measurement
    if scenario.noise.estimated and scenario.noise.true_levels(model.m) is None:
        mistakes.append(NO_LEVEL)
    elif untried is None or scenario in untried:
        require_function(model)
        mistakes += _beyond_numbers(scenario)
        require_function(scenario.simulator)
    for label, estimator in estimators.items():
        why = estimator.hindrance(scenario.problem)
        if why:
            mistakes.append(f"estimators.{label}: {why}; leave it out")
    return mistakes


def _beyond_numbers(scenario: Scenario) -> Iterator[str]:
    """Scales at which every statistic would be infinite or 0, as no number holds their squares."""
    if scenario.error_scale > LARGEST:
        yield (
            f"error_scale={scenario.error_scale:g}: its square overflows; give a number up to"
            f" {LARGEST:g}"
        )
        return
    model = scenario.measurement
    real = scenario.noise.real
    if model.m < model.n:
        yield (
            f"measurement={model.name}: {model.m} readings are too few for {model.n} parameters;"
            " take more readings, or fix a parameter by parameters.NAME.fixed=VALUE"
        )
        return
    with np.errstate(all="ignore"):
        bound = scenario.linear_bound
        try:
            few = scenario.draw(0, 1 if real else _FEW)
        except UserError:
            raise
        except Exception:  # what cannot be drawn is a failure of its blocks, and told of there
            return
    if not real and not finite(few.z).any():
        reason = scenario.simulator.hindrance(few.x[0])
        yield (
            f"measurement={model.name}: none of the first {_FEW} trials has readings: {reason};"
            " choose smaller scales"
        )
        return
    representable = (bound >= 1 / LARGEST) & (bound <= LARGEST)
    beyond = ~(representable | (bound == 0))
    if real and np.isnan(bound).any():
        # J lacks rank at the start, or is not finite there: that is a hard start, and no mistake.
        return
    if np.isnan(bound).any():
        H = scenario.problem.H
        still = [
            parameter.name for i, parameter in enumerate(model.parameters) if not H[:, i].any()
        ]
        where = f"readings do not change with {', '.join(still)} at the start"
        if not still:
            where = "readings at the start do not determine"
            where += f" {', '.join(_undetermined(scenario)) or 'all parameters'}"
        yield (
            f"measurement={model.name}: {where}; choose another start or further readings,"
            " or try `ipe-bench check` if the slopes are wrong"
        )
        return
    for i in np.flatnonzero(beyond)[:1]:
        yield (
            f"noise={scenario.noise.name}: {model.parameters[i].name} has a linear bound of"
            f" {bound[i]:g} of its size, whose square is beyond numbers; choose another scale of"
            " the noise"
        )


def _undetermined(scenario: Scenario) -> list[str]:
    """Names the parameters that readings at the start leave open; none if H is not
    finite."""
    H = scenario.problem.R.whiten_jacobian(scenario.problem.H)
    if not np.isfinite(H).all():
        return []
    _, values, directions = np.linalg.svd(H, full_matrices=False)
    open_directions = directions[values <= 1e-8 * values[0]]
    share = np.linalg.norm(open_directions, axis=0)
    parameters = scenario.measurement.parameters
    return [parameters[i].name for i in np.flatnonzero(share > 1e-6)]


def result_keys(scenario: AnyScenario, estimators: Mapping[str, Any]) -> list[ResultKey]:
    """Returns the keys of what a run stores of one scenario: its truth, and each estimator."""
    of_estimators = [ResultKey(scenario, label, one) for label, one in estimators.items()]
    return [ResultKey(scenario), *of_estimators]


def new_name() -> str:
    """Returns a name for the record of a run."""
    return f"{datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:8]}"


def record_refusal(
    output: Path | str,
    job: str,
    reason: str,
    scenario: AnyScenario | None = None,
    estimators: Mapping[str, Any] | None = None,
    trials: int = 1,
) -> None:
    """Notes in a folder of results that a job of a sweep, which `job` tells from the others, was
    asked for and refused; scenario and estimators are given if the job came to them."""
    store = Store(Path(output))
    if store.trials.is_dir():
        store.prepare()
        record = _record([scenario] if scenario else [], estimators or {}, trials)
        store.write_run(_refusal(job), {**record, "job": job, "refused": reason})


def accept(output: Path | str, job: str) -> None:
    """Takes back what `record_refusal` noted of a job."""
    record = Store(Path(output)).runs / f"{_refusal(job)}.json"
    record.unlink(missing_ok=True)


def _refusal(job: str) -> str:
    return f"refused-{digest(job)}"


def _record(
    scenarios: Sequence[AnyScenario], estimators: Mapping[str, Any], trials: int
) -> dict[str, Any]:
    cells = [cell for scenario in scenarios for cell in result_keys(scenario, estimators)]
    return {
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds"),
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
    """Returns the commit of the folder, if any; asked once per process, as a sweep records it per
    job."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        found = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()
