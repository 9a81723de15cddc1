"""What is to be computed, cut into tasks, and how a run gets through them whatever happens to its parts.

A task is the cells of one scenario that are missing in one block. Each cell is stored as soon as it is there, so a task
that dies has lost no more than the cell it died of: that one is tried again alone, the rest goes on.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import itertools
import logging
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from ipe_bench.estimators.base import estimate_safely
from ipe_bench.runs.execution.base import FATAL, Execution, Failure
from ipe_bench.runs.provenance import class_modules, describe, digest, fingerprint
from ipe_bench.runs.results import Results
from ipe_bench.runs.store import ResultKey, Store, describe_names
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import HISTORIES, Block

log = logging.getLogger(__name__)

BLOCK_SIZE = 250
"""Trials: at the least, where nobody says how many."""
TRIES = 2
"""How often a cell of a block may take its process with it before it counts as failed."""


@dataclass(frozen=True)
class Task:
    """The unit of work: the cells of one scenario that are missing in one block."""

    directory: Path
    cells: tuple[ResultKey, ...]
    start: int
    stop: int

    @property
    def trusted(self) -> bool:
        """Whether it runs only code of this package, which neither ends its process nor runs without end."""
        parts = [part for cell in self.cells for part in (cell.scenario, cell.estimator) if part is not None]
        return all(name.startswith("ipe_bench.") for name in class_modules(parts))


@dataclass(frozen=True)
class Done:
    """One cell of a task is finished: stored, or failed."""

    cell: int
    seconds: float
    failure: Failure | None = None


PREPARED = "prepared"
"""The step of a task after which an estimator begins: what is imported and compiled once is there."""


@dataclass(frozen=True)
class Progress:
    """What a watcher of a run is told after each cell."""

    done: int
    """Tasks that have ended."""
    tasks: int
    trials: int
    """Trials times estimators that are done."""
    total: int
    """Trials times estimators that were missing when the run began."""
    failures: tuple[str, ...]
    preparing: bool = False
    """Whether nothing has been estimated yet, as code is imported and compiled first."""
    seconds: float = 0.0
    """Time since the first estimator began, after imports and compilation."""
    seconds_left: float | None = None
    """Forecast from what each estimator took per trial; None before a task has ended, and where one has taken none."""

    @property
    def rate(self) -> float:
        """Estimates per second since the first estimator began."""
        return self.trials / self.seconds if self.seconds else 0.0


Watcher = Callable[[Progress], None]


LARGEST_BLOCK = 1000
"""Of more trials at once, the arrays leave a processor's cache: each trial takes longer again."""
_WORTH_BLOCKS = 100


def block_size_for(trials: int) -> int:
    """What is computed at once where nobody says: 250 trials, and more where there still are a hundred blocks."""
    return min(max(trials // _WORTH_BLOCKS // BLOCK_SIZE, 1) * BLOCK_SIZE, LARGEST_BLOCK)


def plan(
    directory: Path, cells: Sequence[ResultKey], results: Results, trials: int, block_size: int | None = None
) -> list[Task]:
    """Blocks on a fixed grid, each with the cells of one scenario that lack some of its trials."""
    block_size = block_size_for(trials) if block_size is None else block_size
    lacking: dict[tuple[int, int], list[ResultKey]] = {}
    for cell in cells:
        for start, stop in results.missing(cell.key, trials):
            edges = [start, *range((start // block_size + 1) * block_size, stop, block_size), stop]
            for edge in itertools.pairwise(edges):
                lacking.setdefault(edge, []).append(cell)
    return [Task(directory, tuple(cells), *edge) for edge, cells in sorted(lacking.items())]


def run_task(task: Task) -> Iterator[Done | str]:
    """Computes one task and stores each cell's rows as soon as they are there. Runs wherever the execution has it run.

    An exception in one cell fails that cell alone. What an estimator does for the first time in a process, such as to
    import a library or to compile a model, it does before its time is taken.
    """
    store, cells, process = Store(task.directory), _recalled(task), os.getpid()
    _check_source(cells)
    with _alone(), np.errstate(all="ignore"):
        block = Block.draw(cells[0].scenario, task.start, task.stop)
        # What all cells share is not to be charged to the first of them.
        _ = block.crlb_information
    for index, cell in enumerate(cells):
        try:
            with _alone(), np.errstate(all="ignore"):
                _prepare(block, cell)
        except KeyboardInterrupt:
            raise
        except BaseException:  # what it raises now, it raises again where that is its own failure
            log.debug("%s: raised while it was prepared", describe_names(cell.names), exc_info=True)
        _end_if_forked(process)
        yield PREPARED
        began = time.perf_counter()
        failure = None
        try:
            with _alone(), np.errstate(all="ignore"):
                _compute_cell(store, block, cell, process)
        except FATAL:
            raise
        except BaseException as error:  # an estimator may raise anything, sys.exit() and KeyboardInterrupt too
            if isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
                raise  # a user's Ctrl-C; where it is ignored, in worker processes, there can be none
            failure = Failure.of(error)
        yield Done(index, time.perf_counter() - began, failure)


_recent: dict[str, ResultKey] = {}
_MOST_RECENT = 64


def _recalled(task: Task) -> tuple[ResultKey, ...]:
    """The cells of a task as this process had them before, with all that they have worked out meanwhile: to trace a
    model and to describe what is constructed takes as long as some ten trials. Those of this package alone: what code
    of others leaves in an object stays in its block."""
    if not task.trusted:
        return task.cells
    if len(_recent) > _MOST_RECENT:
        _recent.clear()
    return tuple(_recent.setdefault(cell.key, cell) for cell in task.cells)


_prepared: set[str] = set()


def _prepare(block: Block, cell: ResultKey) -> None:
    """Has an estimator make a first estimate of a first trial, unless it has made one of this model in this process."""
    if cell.estimator is None:
        return
    model = cell.scenario.measurement
    compiled = describe(model) if model.by_differential_equations else type(model).__qualname__
    what = digest([describe(cell.estimator), compiled])
    if what not in _prepared:
        _prepared.add(what)
        estimate_safely(cell.estimator, block.problem, block.trials.z[:1])


def _end_if_forked(process: int) -> None:
    """Ends the copy of this process that an estimator made and returned in: it would tell and store the same again."""
    if os.getpid() != process:
        os._exit(0)


def _alone() -> Any:
    """One thread in BLAS, whatever the part before has asked for."""
    return _blas().limit(limits=1, user_api="blas")


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _compute_cell(store: Store, block: Block, cell: ResultKey, process: int) -> None:
    start, stop = block.trials.start, block.trials.stop
    if cell.estimator is None:
        columns = block.truth_columns()
        store.require()
        store.write(cell, start, stop, columns)
        return
    try:
        estimates, columns = block.estimate(cell.estimator)
    finally:
        _end_if_forked(process)
    store.require()
    history = None
    if start == 0 and estimates.history is not None:
        history = _history_columns(cell.scenario, estimates.history[:HISTORIES])
    store.write(cell, start, stop, columns, history)


def _check_source(cells: Sequence[ResultKey]) -> None:
    """Refuses to compute under a key that stands for other source than is installed here."""
    for cell in cells:
        parts = [cell.scenario] if cell.estimator is None else [cell.scenario, cell.estimator]
        if fingerprint(parts) != cell.made_by:
            raise RuntimeError(
                "the numerical source of ipe-bench or of a plugin is not what it was where the run began: "
                "install the same versions on all machines, or start the run again"
            )


def _history_columns(scenario: Scenario, history: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    x = np.concatenate(list(history))
    lengths = [len(rows) for rows in history]
    return {
        "trial": np.repeat(np.arange(len(history)), lengths),
        "iteration": np.concatenate([np.arange(length) for length in lengths]),
        **{f"x_{p.name}": x[:, i] for i, p in enumerate(scenario.measurement.parameters)},
    }


class RunLog:
    """The log file of a run. Warnings go to the logger as well, whose listeners are the user's business."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.file = path.open("a", encoding="utf-8", buffering=1)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(OSError):
            self.file.close()

    def info(self, text: str) -> None:
        # A log that cannot be written must not be what ends a run: the results will say so.
        with contextlib.suppress(OSError):
            self.file.write(f"{datetime.datetime.now().isoformat(sep=' ', timespec='seconds')}  {text}\n")

    def warning(self, text: str) -> None:
        self.info(text)
        log.warning(text)


class RunProgress:
    """What has become of the cells of a run's tasks."""

    def __init__(self, store: Store, tasks: Sequence[Task], watch: Watcher, log: RunLog) -> None:
        self.log = log
        self.store = store
        self.watch = watch
        self.total = sum(_weight(task, cell) for task in tasks for cell in task.cells)
        self.left = Counter((id(cell.scenario), task.start, task.stop) for task in tasks for cell in task.cells)
        self.done = 0
        self.trials = 0
        self.failures: list[str] = []
        self.began: float | None = None
        """When the first estimator did."""
        self.ahead: Counter[str] = Counter()
        """Trials that are left, by what is computed of them."""
        for task in tasks:
            self.ahead.update(dict.fromkeys([cell.key for cell in task.cells], task.stop - task.start))
        self.taken: dict[str, tuple[float, int]] = {}
        """Seconds and trials of what is done."""
        self.tell()

    def begin(self) -> None:
        """Notes that an estimator begins."""
        if self.began is None:
            self.began = time.monotonic()
            self.tell()

    def close(self, task: Task, cell: ResultKey, failure: Failure | None, seconds: float | None = None) -> None:
        """Notes that a cell of a task is stored, or has failed for good."""
        self.left[id(cell.scenario), task.start, task.stop] -= 1
        self.done += self.left[id(cell.scenario), task.start, task.stop] == 0
        self.trials += _weight(task, cell)
        self.ahead[cell.key] -= task.stop - task.start
        if seconds is not None:
            before = self.taken.get(cell.key, (0.0, 0))
            self.taken[cell.key] = before[0] + seconds, before[1] + task.stop - task.start
        what = f"{describe_names(cell.names)}, trials {task.start} to {task.stop}"
        if failure is None:
            self.log.info(f"{what}: stored" + ("" if seconds is None else f" after {seconds:.3g} s"))
        else:
            self.failures.append(f"{what}: {failure.message}")
            self.log.info("\n".join(filter(None, [f"{what}: failed: {failure.message}", failure.detail.rstrip()])))
            self.store.write_failure(cell, task.start, task.stop, failure)
        self.tell()

    def tell(self) -> None:
        seconds = 0.0 if self.began is None else time.monotonic() - self.began
        preparing = self.began is None and bool(self.left)
        self.watch(
            Progress(
                *(self.done, len(self.left), self.trials, self.total, tuple(self.failures), preparing, seconds),
                self._seconds_left(seconds),
            )
        )

    def _seconds_left(self, seconds: float) -> float | None:
        """The time that has passed, in proportion to the computing time that is ahead."""
        spent = sum(taken for taken, _ in self.taken.values())
        if not self.done or not spent:
            return None
        ahead = [(key, trials) for key, trials in self.ahead.items() if trials]
        if any(key not in self.taken for key, _ in ahead):
            return None
        return seconds / spent * sum(trials * self.taken[key][0] / self.taken[key][1] for key, trials in ahead)


def run_tasks(
    tasks: Sequence[Task], execution: Execution, store: Store, watch: Watcher, log: RunLog
) -> tuple[str, ...]:
    """Runs tasks until each of their cells is stored or has failed; returns the messages of those that failed.

    Raises:
        StorageError: nothing can be stored any more.
    """
    log.info(f"{len(tasks)} blocks to compute with execution {execution}")
    progress = RunProgress(store, tasks, watch, log)
    tries: Counter[tuple[str, int, int]] = Counter()
    while tasks:
        closed: list[set[int]] = [set() for _ in tasks]
        prepared: set[int] = set()
        again: list[Task] = []
        for event in execution.run(run_task, tasks):
            task = tasks[event.index]
            if isinstance(event.step, Done):
                closed[event.index].add(event.step.cell)
                cell, failure = task.cells[event.step.cell], event.step.failure
                if failure is None and not store.has(cell, task.start, task.stop):
                    failure = Failure("died", "was said to be stored and is not; run the same command again")
                progress.close(task, cell, failure, event.step.seconds)
            elif event.step == PREPARED:
                prepared.add(event.index)
                progress.begin()
            if not event.ended or event.failure is None:
                continue
            left = []
            for i, cell in enumerate(task.cells):
                if i in closed[event.index]:
                    continue
                if store.has(cell, task.start, task.stop):  # stored, and the news of it was lost
                    progress.close(task, cell, None)
                else:
                    left.append(cell)
            if event.failure.status == "error" or (event.failure.status == "timeout" and event.index not in prepared):
                # What all of them need failed.
                for cell in left:
                    progress.close(task, cell, event.failure)
                continue
            if not left:
                continue
            # Cells are computed in order, so the first one that is not there is the one that it happened in.
            culprit, *rest = left
            tries[culprit.key, task.start, task.stop] += 1
            if event.failure.status == "died" and tries[culprit.key, task.start, task.stop] < TRIES:
                where = f"{describe_names(culprit.names)}, trials {task.start} to {task.stop}"
                log.warning(f"{where}: {event.failure.message}; trying it again")
                again.append(Task(task.directory, (culprit,), task.start, task.stop))
            else:
                progress.close(task, culprit, event.failure)
            if rest:
                again.append(Task(task.directory, tuple(rest), task.start, task.stop))
        tasks = again
    log.info(f"done, {len(progress.failures)} failed")
    return tuple(progress.failures)


def _weight(task: Task, cell: ResultKey) -> int:
    return 0 if cell.estimator is None else task.stop - task.start
