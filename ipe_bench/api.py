"""The whole bench as one function: scenarios and estimators in, a table of statistics out. It knows no Hydra."""

from __future__ import annotations

import datetime
import itertools
import os
import platform
import subprocess
import tempfile
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from ipe_bench import __version__
from ipe_bench.components import describe, fingerprint
from ipe_bench.errors import UserError
from ipe_bench.estimation import Estimator
from ipe_bench.execution import Execution, Serial
from ipe_bench.montecarlo import HISTORIES, Block
from ipe_bench.scenario import Scenario
from ipe_bench.store import Cell, Store

if TYPE_CHECKING:
    import pandas as pd

BLOCK_SIZE = 250


@dataclass(frozen=True)
class Task:
    """The unit of work: the cells of one scenario that are missing in one block."""

    directory: Path
    cells: tuple[Cell, ...]
    start: int
    stop: int


@dataclass(frozen=True)
class Progress:
    """What a watcher of a run is told after each task."""

    done: int
    tasks: int
    trials: int
    """Trials times estimators in the tasks done so far."""
    failures: tuple[str, ...]


Watcher = Callable[[Progress], None]


def run(
    scenarios: Scenario | Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int = 1000,
    *,
    output: Path | str | None = None,
    execution: Execution | None = None,
    block_size: int = BLOCK_SIZE,
    watch: Watcher | None = None,
) -> pd.DataFrame:
    """Runs every estimator on the same trials of every scenario and summarises what is known of them.

    `estimators` maps labels to estimators. What `output` holds already is not computed again; without `output` nothing
    is kept. Returns the tidy summary: a row per scenario, estimator and parameter, plus the parameter `all`.

    Raises:
        UserError: what was asked for cannot be computed; nothing has been computed then.
    """
    from ipe_bench.statistics import summarize

    scenarios = [scenarios] if isinstance(scenarios, Scenario) else list(scenarios)
    if output is None:
        with tempfile.TemporaryDirectory(prefix="ipe-bench-") as folder:
            compute(scenarios, estimators, trials, folder, execution=execution, block_size=block_size, watch=watch)
            return summarize([folder])
    compute(scenarios, estimators, trials, output, execution=execution, block_size=block_size, watch=watch)
    return summarize([output])


def compute(
    scenarios: Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int,
    output: Path | str,
    *,
    execution: Execution | None = None,
    block_size: int = BLOCK_SIZE,
    watch: Watcher | None = None,
) -> tuple[str, ...]:
    """Computes and stores what is missing under `output`; returns the messages of the blocks that failed."""
    check(scenarios, estimators, trials, block_size)
    store = Store(output)
    _write_record(store, scenarios, estimators, trials)
    tasks = [task for scenario in scenarios for task in _tasks(store, _cells(scenario, estimators), trials, block_size)]
    failures: list[str] = []
    watch = watch or (lambda progress: None)
    watch(Progress(0, len(tasks), 0, ()))
    done = 0
    for count, outcome in enumerate((execution or Serial()).run(perform, tasks), 1):
        task = tasks[outcome.index]
        if outcome.failure is not None:
            failures.append(f"trials {task.start} to {task.stop}: {outcome.failure}")
        done += (task.stop - task.start) * (len(task.cells) - 1)
        watch(Progress(count, len(tasks), done, tuple(failures)))
    return tuple(failures)


def check(
    scenarios: Sequence[Scenario], estimators: Mapping[str, Estimator], trials: int, block_size: int = BLOCK_SIZE
) -> None:
    """Raises one UserError with everything that stands in the way of this run."""
    mistakes = []
    if trials < 1:
        mistakes.append(f"trials={trials}: give a whole number above 0")
    if block_size < 1:
        mistakes.append(f"block_size={block_size}: give a whole number above 0")
    if not scenarios:
        mistakes.append("there is no scenario; give at least one")
    if not estimators:
        mistakes.append("there is no estimator; choose with solver= and baseline=")
    for scenario in scenarios:
        for label, estimator in estimators.items():
            for need in estimator.missing(scenario.problem):
                name = scenario.measurement.name
                mistakes.append(
                    f"estimators.{label}: needs {need}, which measurement={name} does not have; leave it out"
                )
    if mistakes:
        raise UserError("; ".join(dict.fromkeys(mistakes)))


def _cells(scenario: Scenario, estimators: Mapping[str, Estimator]) -> list[Cell]:
    return [Cell(scenario), *(Cell(scenario, label, estimator) for label, estimator in estimators.items())]


def _tasks(store: Store, cells: Sequence[Cell], trials: int, block_size: int) -> list[Task]:
    """Blocks on a fixed grid, each with the cells that lack some of its trials."""
    lacking: dict[tuple[int, int], list[Cell]] = {}
    for cell in cells:
        for start, stop in store.missing(cell, trials):
            edges = [start, *range((start // block_size + 1) * block_size, stop, block_size), stop]
            for edge in itertools.pairwise(edges):
                lacking.setdefault(edge, []).append(cell)
    return [Task(store.directory, tuple(cells), *edge) for edge, cells in sorted(lacking.items())]


def perform(task: Task) -> None:
    """Computes one task and stores each cell's rows as soon as they are there."""
    store = Store(task.directory)
    with threadpool_limits(limits=1, user_api="blas"):
        block = Block.draw(task.cells[0].scenario, task.start, task.stop)
        for cell in task.cells:
            if cell.estimator is None:
                store.write(cell, task.start, task.stop, block.truth_columns())
                continue
            estimates, columns = block.estimate(cell.estimator)
            if task.start == 0 and estimates.history is not None:
                store.write_history(cell, _history_columns(cell.scenario, estimates.history[:HISTORIES]))
            store.write(cell, task.start, task.stop, columns)


def _history_columns(scenario: Scenario, history: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    x = np.concatenate(list(history))
    lengths = [len(rows) for rows in history]
    return {
        "trial": np.repeat(np.arange(len(history)), lengths),
        "iteration": np.concatenate([np.arange(length) for length in lengths]),
        **{f"x_{p.name}": x[:, i] for i, p in enumerate(scenario.measurement.parameters)},
    }


def _write_record(
    store: Store, scenarios: Sequence[Scenario], estimators: Mapping[str, Estimator], trials: int
) -> None:
    """States what is going to be computed, so that what is missing later is known to be missing."""
    now = datetime.datetime.now(datetime.UTC)
    cells = [cell for scenario in scenarios for cell in _cells(scenario, estimators)]
    record: dict[str, Any] = {
        "started": now.isoformat(timespec="seconds"),
        "trials": trials,
        "scenarios": [describe(s) for s in scenarios],
        "estimators": {label: describe(e) for label, e in estimators.items()},
        "cells": [{"key": c.key, "identity_key": c.footer["identity_key"], "names": c.footer["names"]} for c in cells],
        "versions": _versions(),
        "machine": {"host": platform.node(), "system": platform.platform(), "cores": os.cpu_count()},
        "git_commit": _git_commit(),
        **fingerprint([*scenarios, *estimators.values()]),
    }
    store.write_run(f"{now:%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:8]}", record)


def _versions() -> dict[str, str]:
    import importlib.metadata as metadata

    names = ("numpy", "scipy", "numba", "filterpy", "hydra-core", "pandas", "pyarrow", "seaborn", "matplotlib")
    return {"python": platform.python_version(), "ipe-bench": __version__} | {n: metadata.version(n) for n in names}


def _git_commit() -> str | None:
    """The commit of the working folder, where it is in a repository."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
