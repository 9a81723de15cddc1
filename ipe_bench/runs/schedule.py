"""The work of a run, cut into tasks, and how the run completes them although parts of it may fail.

A task is the cells of one scenario that are missing in one block. Each cell is stored as soon as it
is there, so a task that dies has lost no more than the cell it died of: that one is tried again
alone, the rest goes on.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.options import component_classes
from ipe_bench.runs.execution import FATAL, PREPARED, Execution, Failure
from ipe_bench.runs.provenance import describe, digest, importable
from ipe_bench.runs.results import Results
from ipe_bench.runs.store import ResultKey, Store, describe_names
from ipe_bench.trials.paths import block_of
from ipe_bench.trials.thresholds import HISTORIES

log = logging.getLogger(__name__)

BLOCK_SIZE = 250
"""Trials of a block, at least, by default."""
LARGEST_BLOCK = 1000
"""Largest default block: beyond it arrays leave a processor's cache, and each trial takes
longer."""
_WORTH_BLOCKS = 100
TRIES = 2
"""Number of times that a cell of a block may take its process with it before it counts as
failed."""


@dataclass(frozen=True)
class Task:
    """Names the unit of work: the cells of one scenario that are missing in one block."""

    directory: Path
    cells: tuple[ResultKey, ...]
    start: int
    stop: int


class Progress:
    """Counts how far a run is; its watcher is called with it after each cell."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        cells = [(task, cell) for task in tasks for cell in task.cells]
        self.total = sum(_weight(*one) for one in cells)
        """Trials times estimators that were missing when the run began."""
        self.trials = 0
        """Trials times estimators that are done."""
        self.failures: list[str] = []
        self.began: float | None = None
        """Time when the first estimator began, by the monotonic clock: code is imported and
        compiled before."""
        self._left = Counter((id(cell.scenario), task.start, task.stop) for task, cell in cells)
        """Cells of each task that are not done."""

    def close(self, task: Task, cell: ResultKey, failure: Failure | None) -> None:
        """Notes that a cell of a task is stored, or has failed for good."""
        self._left[id(cell.scenario), task.start, task.stop] -= 1
        self.trials += _weight(task, cell)
        if failure is not None:
            self.failures.append(f"{_described(task, cell)}: {failure.message}")

    @property
    def tasks(self) -> int:
        return len(self._left)

    @property
    def done(self) -> int:
        """Tasks that have ended."""
        return sum(left == 0 for left in self._left.values())


Watcher = Callable[[Progress], None]


def block_size_for(trials: int) -> int:
    """Returns the default size of a block: 250 trials, and more if there still are a hundred
    blocks."""
    return min(max(trials // _WORTH_BLOCKS // BLOCK_SIZE, 1) * BLOCK_SIZE, LARGEST_BLOCK)


def plan(
    directory: Path, cells: Sequence[ResultKey], results: Results, trials: int, block_size: int
) -> list[Task]:
    """Cuts missing trials into blocks on a fixed grid, each with the cells of one scenario that
    lack some of them."""
    lacking: dict[tuple[int, int], list[ResultKey]] = {}
    for cell in cells:
        _ = cell.importable  # as it is here, and not where the cell is sent
        for start, stop in results.missing(cell.key, trials):
            inner = range((start // block_size + 1) * block_size, stop, block_size)
            for edge in itertools.pairwise([start, *inner, stop]):
                lacking.setdefault(edge, []).append(cell)
    return [Task(directory, tuple(cells), *edge) for edge, cells in sorted(lacking.items())]


def run_task(task: Task) -> Iterator[str | tuple[int, Failure | None]]:
    """Computes one task and stores each cell's rows as soon as they are there; then yields the
    cell's place in the task, and its failure if there was one: an exception fails its cell alone.
    Libraries are imported and models compiled before time is taken."""
    store = Store(task.directory)
    cells = _recalled(task)
    with _alone():
        block = block_of(cells[0].scenario, task.start, task.stop)
        block.share()  # which is not to be charged to the first of the cells
    for index, cell in enumerate(cells):
        # What it raises now, it raises again below.
        with contextlib.suppress(Exception, SystemExit), _alone():
            _warm_up(block, cell)
        yield PREPARED
        failure = None
        try:
            with _alone():
                _compute_cell(store, block, cell)
        except FATAL:
            raise
        except (Exception, SystemExit) as error:
            failure = Failure.of(error)
        yield index, failure


_recent: dict[str, ResultKey] = {}
_MOST_RECENT = 64


def _recalled(task: Task) -> tuple[ResultKey, ...]:
    """Returns the cells of a task as this process had them before, with all that they have worked
    out meanwhile: to trace a model and to describe what is constructed takes as long as some ten
    trials."""
    if len(_recent) > _MOST_RECENT:
        _recent.clear()
    for cell in task.cells:
        known = _recent.get(cell.key)
        if known is None or component_classes(known.components) != component_classes(
            cell.components
        ):
            _require_same_source(cell)
            _recent[cell.key] = cell
    return tuple(_recent[cell.key] for cell in task.cells)


def _require_same_source(cell: ResultKey) -> None:
    """Raises RuntimeError if this process does not compute with what the run began with."""
    if importable(cell.components) != cell.importable:
        raise RuntimeError(
            "the numerical source of ipe-bench or of a plugin is not what it was where the run"
            " began: install the same versions on all machines, or start the run again"
        )


_warm: set[str] = set()


def _warm_up(block: Any, cell: ResultKey) -> None:
    """Runs the estimator on a first trial, unless it has run on this model in this process."""
    if cell.estimator is None:
        return
    model = cell.scenario.measurement
    by_equations = getattr(model, "by_differential_equations", False)
    compiled = describe(model) if by_equations else type(model).__qualname__
    what = digest([describe(cell.estimator), compiled, cell.made_by["source"]])
    if what not in _warm:
        _warm.add(what)
        block.warm_up(cell.estimator)


_blas = functools.cache(ThreadpoolController)


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Limits BLAS to one thread, and silences NumPy's warnings."""
    with _blas().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
        yield


def _compute_cell(store: Store, block: Any, cell: ResultKey) -> None:
    """Computes a cell of a block and stores it."""
    start = block.start
    stop = start + len(block)
    history = None
    if cell.estimator is None:
        columns = block.truth_columns()
    else:
        estimates, columns = block.estimate(cell.estimator)
        if start < HISTORIES and estimates.history is not None:
            history = _iterates(cell, start, estimates.history[: HISTORIES - start])
    if not store.trials.is_dir():  # what it held is missing, and would not be missed
        raise StorageError(
            f"{store.directory}: went away while it was being filled; the same command starts anew"
        )
    store.write(cell, start, stop, columns, history)


def _iterates(cell: ResultKey, start: int, paths: Sequence[Any]) -> dict[str, Any]:
    """Writes the iterates of trials from `start` on as columns."""
    trials = np.arange(start, start + len(paths))
    history = {
        "trial": np.repeat(trials, [len(path) for path in paths]),
        "iteration": np.concatenate([np.arange(len(path)) for path in paths]),
    }
    parameters = cell.scenario.measurement.parameters
    for parameter, values in zip(parameters, np.concatenate(paths).T, strict=True):
        history[f"x_{parameter.name}"] = values
    return history


class _Run:
    """Keeps what has become of the cells of a run."""

    def __init__(self, tasks: Sequence[Task], store: Store, watch: Watcher) -> None:
        self.progress = Progress(tasks)
        self.store = store
        self.watch = watch
        self.tries = Counter[tuple[str, int]]()
        watch(self.progress)

    def begin(self) -> None:
        """Notes when the first estimator begins."""
        if self.progress.began is None:
            self.progress.began = time.monotonic()
            self.watch(self.progress)

    def close(self, task: Task, cell: ResultKey, failure: Failure | None = None) -> None:
        """Notes that a cell is stored, or has failed for good."""
        self.progress.close(task, cell, failure)
        if failure is not None:
            self.store.write_failure(cell, task.start, task.stop, failure)
        self.watch(self.progress)

    def tried_again(
        self, task: Task, cells: Sequence[ResultKey], failure: Failure
    ) -> Iterator[Task]:
        """Closes the cells that a task failed of, and yields tasks for those of its `cells` that
        are tried again."""
        left = []
        for cell in cells:
            if self.store.has(cell, task.start, task.stop):  # stored, and the news of it was lost
                self.close(task, cell)
            else:
                left.append(cell)
        # Cells are computed in order, so the first one that is not there is the one that it
        # happened in; an error outside of cells is of what all of them need.
        blamed = len(left) if failure.status == "error" else 1
        for cell in left[:blamed]:
            self.tries[cell.key, task.start] += 1
            if failure.status == "died" and self.tries[cell.key, task.start] < TRIES:
                log.warning(f"{_described(task, cell)}: {failure.message}; trying it again")
                yield replace(task, cells=(cell,))
            else:
                self.close(task, cell, failure)
        if left[blamed:]:
            yield replace(task, cells=tuple(left[blamed:]))


def run_tasks(
    tasks: Sequence[Task], execution: Execution, store: Store, watch: Watcher
) -> tuple[str, ...]:
    """Runs tasks until each of their cells is stored or has failed; returns the messages of those
    that failed."""
    run = _Run(tasks, store, watch)
    while tasks:
        waiting = [dict(enumerate(task.cells)) for task in tasks]
        again: list[Task] = []
        for event in execution.run(run_task, tasks):
            task = tasks[event.index]
            if event.step == PREPARED:
                run.begin()
            elif event.step is not None:
                index, failure = event.step
                waiting[event.index].pop(index, None)
                if failure is None and not store.has(task.cells[index], task.start, task.stop):
                    failure = Failure(
                        "died", "was said to be stored and is not; run the same command again"
                    )
                run.close(task, task.cells[index], failure)
            if event.failure is not None:
                again += run.tried_again(task, list(waiting[event.index].values()), event.failure)
        tasks = again
    return tuple(run.progress.failures)


def _described(task: Task, cell: ResultKey) -> str:
    return f"{describe_names(cell.names)}, trials {task.start} to {task.stop}"


def _weight(task: Task, cell: ResultKey) -> int:
    return 0 if cell.estimator is None else task.stop - task.start
