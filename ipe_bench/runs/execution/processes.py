"""Tasks in worker processes of this machine, each watched on its own.

A pool of joblib or concurrent.futures breaks as a whole when one worker dies, does not say which task it died of, and
cannot stop one task; Pebble's workers share one pipe and its locks, and need a `__main__` guard. Here each worker has a
pipe of its own: the task of a dead worker is known, a task that exceeds its time is ended with its worker and the
processes that it started, and the others never notice.
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
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any

import cloudpickle

from ipe_bench.basics.machine import cores
from ipe_bench.runs.execution.base import Event, Failure, LimitedExecution, ResourceLimits, Serial, Work

_THREADED = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB", "NUMEXPR")
_PREPARATION_S = 60.0


@dataclass(frozen=True)
class Processes(LimitedExecution):
    """Runs tasks in processes of this machine, with one thread in BLAS and one in compiled models each.

    Workers outlive a run and serve the next one in this process. Fewer tasks than workers leave cores idle, so then the
    compiled models get several threads.
    """

    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        workers = min(self.workers or cores(), len(tasks))
        threads = 1 if self.workers else max(1, cores() // max(workers, 1))
        return supervise(work, tasks, workers, threads, self.limits)


@dataclass(frozen=True)
class Auto(Processes):
    """Worker processes as in `Processes`, except that a single task without limits runs in this process.

    A worker takes seconds to start, which a job of one block does not win back; compiled models use every core without.
    """

    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        if len(tasks) == 1 and self.limits == ResourceLimits():
            return Serial().run(work, tasks)
        return super().run(work, tasks)


def supervise(work: Work, tasks: Sequence[Any], workers: int, threads: int, limits: ResourceLimits) -> Iterator[Event]:
    """Runs tasks in at most `workers` processes with `threads` threads each; see `Execution.run`.

    A worker whose task exceeds its time is ended. The first step has a minute in any case: a new worker has to load
    compiled code.
    """
    waiting = deque(range(len(tasks)))
    busy: dict[Connection, _Worker] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                index = waiting.popleft()
                worker = _begun(index, (sys.path, threads, limits, cloudpickle.dumps((work, tasks[index]))))
                busy[worker.connection] = worker
            deadline = min(worker.deadline for worker in busy.values())
            patience = None if deadline == math.inf else max(0.0, deadline - time.monotonic())
            for connection in wait(list(busy), patience):
                worker = busy[connection]  # pyright: ignore[reportArgumentType]
                kind, value = worker.receive()
                if kind == "started":
                    worker.extend(None if limits.seconds is None else max(limits.seconds, _PREPARATION_S))
                elif kind == "step":
                    worker.extend(limits.seconds)
                    yield Event(worker.index, value)
                else:
                    del busy[worker.connection]
                    if kind != "died":
                        _idle[os.getpid()].append(worker)
                    if kind == "fatal":
                        raise value
                    yield Event(worker.index, ended=True, failure=value)
            now = time.monotonic()
            for worker in [w for w in busy.values() if w.deadline <= now and not w.connection.poll()]:
                del busy[worker.connection]
                worker.end()
                failure = Failure("timeout", f"exceeded block_timeout_s={limits.seconds:g}")
                yield Event(worker.index, ended=True, failure=failure)
    finally:
        for worker in busy.values():
            worker.end()


class _Worker:
    """One worker process, and what it is doing."""

    def __init__(self) -> None:
        self.connection, there = Pipe()
        handle = there.fileno()
        command = [sys.executable, "-P", "-m", "ipe_bench.runs.execution.worker", str(handle)]
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        options: dict[str, Any] = {"pass_fds": (handle,)}
        if sys.platform == "win32":
            os.set_handle_inheritable(handle, True)
            options = {"close_fds": False}
        # In a session of its own, so that Ctrl-C in a terminal reaches the parent alone.
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **{f"{name}_NUM_THREADS": "1" for name in _THREADED}, "PYTHONPATH": path},
            start_new_session=True,
            **options,
        )
        there.close()
        self.index = -1
        self.deadline = math.inf

    def extend(self, seconds: float | None) -> None:
        """Gives it that long for its next step."""
        self.deadline = math.inf if seconds is None else time.monotonic() + seconds

    def receive(self) -> tuple[str, Any]:
        """Its next message; 'died' where there will be none."""
        try:
            return self.connection.recv()
        except (EOFError, OSError, pickle.UnpicklingError):
            self.end()
            return "died", Failure("died", f"the worker process {_describe_exit(self.process.returncode)}")

    def end(self) -> None:
        """Ends the process without asking it, and those that it started: its session is of its own."""
        with contextlib.suppress(OSError):
            self.connection.close()
        # One that has closed its pipe is on its way out: give it the time to leave its own exit code.
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
"""By process: workers of another one, that this one was forked from, are not ours."""


def _begun(index: int, message: Any) -> _Worker:
    """An idle worker, else a new one, that was handed a task."""
    kept = _idle.setdefault(os.getpid(), [])
    while True:
        worker = kept.pop() if kept else _Worker()
        worker.index, worker.deadline = index, math.inf
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
