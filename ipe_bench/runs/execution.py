"""Where tasks run: one after another in this process, or in worker processes. Config group
`execution`.

A pool of joblib or concurrent.futures breaks as a whole when one worker dies, does not say which
task it died of, and cannot stop one task; pebble can, but has no steps within a task, by which a
limit on time begins after compilation, and leaves alive the processes that a task has started. Here
each worker has a pipe and a session of its own: the task of a dead worker is known, and a task that
exceeds its time is ended with all that it started, while the others go on.
"""

from __future__ import annotations

import atexit
import contextlib
import math
import os
import pickle
import signal
import subprocess
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from typing import Annotated, Any, Literal

import cloudpickle
from annotated_types import Gt, Lt, doc

from ipe_bench.basics.errors import StorageError, UserError, describe_exception
from ipe_bench.basics.machine import cores
from ipe_bench.basics.options import Component, Count

Work = Callable[[Any], Iterable[Any]]
"""Does a task, which is anything that can be pickled, in steps: what it yields after each step is
handed on."""

_LONGEST = 1e9
"""Seconds, and 1e9 bytes, beyond which no limit is meant: thirty years, and more memory than there
is."""
Limit = Annotated[float, Gt(0), Lt(_LONGEST), doc(f"a number above 0 and below {_LONGEST:g}")]
"""A limit on seconds or gigabytes."""
FATAL = (UserError, StorageError)
"""Exceptions that concern the whole run: they end it, where any other is a failure of one task."""
_THREADED = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB", "NUMEXPR")
PREPARED = "prepared"
"""The step of a task after which time counts: what is imported and compiled once is there."""
_PREPARATION_S = 60.0


@dataclass(frozen=True)
class Failure:
    """Says why a task did not end well."""

    status: Literal["error", "timeout", "died"]
    """It raised; it exceeded a time limit; or it never began, or the process that it ran in
    ended."""
    message: str
    detail: str = ""
    """The traceback, where there is one."""

    @classmethod
    def of(cls, error: BaseException) -> Failure:
        return cls("error", describe_exception(error), "".join(traceback.format_exception(error)))


@dataclass(frozen=True)
class Event:
    """Says of one task that a step was done, or that it ended."""

    index: int
    """The task's place in the sequence that was given."""
    step: Any = None
    ended: bool = False
    failure: Failure | None = None


class Execution(Component, ABC):
    """Runs the tasks of a bench. A new execution is a frozen dataclass whose fields are its
    options.

    Required: `run(work, tasks)`, which yields an event per step of `work(task)`, and one with
    `ended` per task. Optional: nothing else. Tasks, and `work`, can be pickled, and may run in any
    order, process or machine. Promised: an exception in `work` fails its task alone, with
    `Failure.of`; one of `FATAL`, or closing the iterator, stops what is under way.

    >>> @dataclass(frozen=True)
    ... class LastFirst(Execution):
    ...     def run(self, work, tasks):
    ...         for index in reversed(range(len(tasks))):
    ...             yield from (Event(index, step) for step in work(tasks[index]))
    ...             yield Event(index, ended=True)
    >>> events = LastFirst().run(lambda word: word.split(), ["one", "two three"])
    >>> [(event.index, event.step) for event in events]
    [(1, 'two'), (1, 'three'), (1, None), (0, 'one'), (0, None)]
    """

    @abstractmethod
    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        """Yields the events of all tasks."""


@dataclass(frozen=True)
class Serial(Execution):
    """Runs tasks in this process; compiled models still use every core.

    An estimator is not isolated from this process: one that never returns, or ends the process,
    ends the run.
    """

    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        for index, task in enumerate(tasks):
            failure = None
            try:
                for step in work(task):
                    yield Event(index, step)
            except FATAL:
                raise
            except (Exception, SystemExit) as error:
                failure = Failure.of(error)
            yield Event(index, ended=True, failure=failure)


@dataclass(frozen=True)
class Processes(Execution):
    """Runs tasks in processes of this machine, with one thread in BLAS and one in compiled models
    each.

    Workers outlive a run and serve the next one in this process. Fewer tasks than workers leave
    cores idle, so then the compiled models get several threads.
    """

    workers: Count | None = None
    """How many processes; None: one per core."""
    block_timeout_s: Limit | None = None
    """Seconds that one estimator may take for one block, besides a minute for imports and
    compilation; None: no limit."""
    memory_limit_gb: Limit | None = None
    """Memory that one worker may use, in 1e9 bytes; None: no limit. Linux only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.memory_limit_gb is not None and not sys.platform.startswith("linux"):
            raise UserError(
                f"memory_limit_gb={self.memory_limit_gb}: can be enforced on Linux only; give null"
            )

    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        workers = min(self.workers or cores(), len(tasks))
        threads = 1 if self.workers else max(1, cores() // max(workers, 1))
        return supervise(work, tasks, workers, threads, self.block_timeout_s, self.memory_limit_gb)


@dataclass(frozen=True)
class Auto(Processes):
    """Worker processes as in `Processes`, except that a single task without limits runs in this
    process.

    A worker takes seconds to start, which a job of one block does not win back; compiled models use
    every core without.
    """

    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        if len(tasks) == 1 and self.block_timeout_s is None and self.memory_limit_gb is None:
            return Serial().run(work, tasks)
        return super().run(work, tasks)


def supervise(
    work: Work,
    tasks: Sequence[Any],
    workers: int,
    threads: int,
    timeout_s: float | None = None,
    memory_gb: float | None = None,
) -> Iterator[Event]:
    """Runs tasks in at most `workers` processes with `threads` threads each; see `Execution.run`. A
    worker whose task takes longer than `timeout_s` from the step `PREPARED` to the next one is
    ended, and one that takes longer than a minute, too, to get there."""
    prepares_s = None if timeout_s is None else max(timeout_s, _PREPARATION_S)
    waiting = deque(range(len(tasks)))
    busy: dict[Connection, _Worker] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                index = waiting.popleft()
                payload = cloudpickle.dumps((work, tasks[index]))
                worker = _begun(index, (sys.path, threads, memory_gb, payload))
                busy[worker.connection] = worker
            deadline = min(worker.deadline for worker in busy.values())
            patience = None if deadline == math.inf else max(0.0, deadline - time.monotonic())
            for connection in wait(list(busy), patience):
                worker = busy[connection]  # pyright: ignore[reportArgumentType]
                kind, value = worker.receive()
                if kind == "started":
                    worker.fresh = True
                    worker.extend(prepares_s)
                elif kind == "step":
                    worker.extend(timeout_s if value == PREPARED else prepares_s)
                    yield Event(worker.index, value)
                elif (
                    kind == "died" and not worker.fresh
                ):  # it was ending while it was handed this task
                    del busy[connection]  # pyright: ignore[reportArgumentType]
                    waiting.appendleft(worker.index)
                else:
                    del busy[worker.connection]
                    if kind != "died":
                        _idle[os.getpid()].append(worker)
                    if kind == "fatal":
                        raise value
                    yield Event(worker.index, ended=True, failure=value)
            now = time.monotonic()
            for worker in [
                w for w in busy.values() if w.deadline <= now and not w.connection.poll()
            ]:
                del busy[worker.connection]
                worker.end()
                failure = Failure("timeout", f"exceeded block_timeout_s={timeout_s:g}")
                yield Event(worker.index, ended=True, failure=failure)
    finally:
        for worker in busy.values():
            worker.end()


class _Worker:
    """Holds one worker process, and what it is doing."""

    def __init__(self) -> None:
        self.connection, there = Pipe()
        handle = there.fileno()
        command = [sys.executable, "-P", "-m", "ipe_bench.runs.worker", str(handle)]
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        options: dict[str, Any] = {"pass_fds": (handle,)}
        if sys.platform == "win32":
            os.set_handle_inheritable(handle, True)
            options = {"close_fds": False}
        # In a session of its own, so that Ctrl-C in a terminal reaches the parent alone.
        env = {**os.environ, "PYTHONPATH": path}
        env |= {f"{name}_NUM_THREADS": "1" for name in _THREADED}
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            env=env,
            start_new_session=True,
            **options,
        )
        there.close()
        self.index = -1
        self.deadline = math.inf
        self.fresh = True
        """Whether a death is the work of the task at hand: false from when it has waited until its
        next task starts."""

    def extend(self, seconds: float | None) -> None:
        """Resets the deadline of the next step; None: there is none."""
        self.deadline = math.inf if seconds is None else time.monotonic() + seconds

    def receive(self) -> tuple[str, Any]:
        """Receives the next message; 'died' if there will be none."""
        try:
            return self.connection.recv()
        except (EOFError, OSError, pickle.UnpicklingError):
            self.end()
            return "died", Failure(
                "died", f"the worker process {_describe_exit(self.process.returncode)}"
            )

    def end(self) -> None:
        """Ends the process, and those that it started in its session, without waiting for the
        task."""
        with contextlib.suppress(OSError):
            self.connection.close()
        # One that has closed its pipe is on its way out: give it the time to leave its own exit
        # code.
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(0.1)
        if sys.platform != "win32":
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait()


def _describe_exit(code: int) -> str:
    if code >= 0:
        return f"ended itself with exit code {code}"
    name = signal.Signals(-code).name
    hint = "; the system may have run out of memory" if name == "SIGKILL" else ""
    return f"was ended by {name}{hint}"


_idle: dict[int, list[_Worker]] = {}
"""Idle workers by the process that started them, since a forked process does not own those of its
parent."""


def _begun(index: int, message: Any) -> _Worker:
    """Hands a task to an idle worker, else to a new one."""
    kept = _idle.setdefault(os.getpid(), [])
    while True:
        if kept:
            worker = kept.pop()
            worker.fresh = False
        else:
            worker = _Worker()
        worker.index = index
        worker.deadline = math.inf
        with contextlib.suppress(OSError):
            if worker.process.poll() is None:
                worker.connection.send(message)
                return worker
        worker.end()  # an idle one has ended in the meantime


@atexit.register
def end_idle() -> None:
    """Ends the workers that wait for another run, and gives back their memory."""
    for worker in _idle.get(os.getpid(), ()):
        worker.end()
    _idle.clear()
