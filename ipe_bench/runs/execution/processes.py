"""Tasks in worker processes of this machine, each watched on its own.

A pool of joblib or concurrent.futures breaks as a whole when one worker dies, does not say which task it died of, and
cannot stop one task. Pebble's does both, but all its workers share one pipe and its locks: a worker that dies between
two tasks breaks the pool for good, scripts need a `__main__` guard, the steps of a task need a pipe and deadlines of
their own anyway, and inside a Dask worker it cannot start processes. Here each worker has a pipe of its own: the task
of a dead worker is known, a task that exceeds its time is ended with its worker and the processes that it started, and
the others never notice.
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
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any

import cloudpickle

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.machine import cores
from ipe_bench.basics.options import Count
from ipe_bench.runs.execution.base import Event, Execution, Failure, Limit, Limits, Task, Work

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)
_PREPARATION_S = 60.0


@dataclass(frozen=True)
class Processes(Execution):
    """Runs tasks in processes of this machine, with one thread in BLAS and one in compiled models each.

    Workers outlive a run and serve the next one in this process. Fewer tasks than workers leave cores idle, so then the
    compiled models get several threads.
    """

    workers: Count | None = None
    """How many processes; None: one per core."""
    block_timeout_s: Limit | None = None
    """Seconds that one estimator may take for one block; None: no limit."""
    memory_limit_gb: Limit | None = None
    """Memory that one worker may use, in 1e9 bytes; None: no limit. Linux only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.memory_limit_gb is not None and not sys.platform.startswith("linux"):
            raise UserError(f"memory_limit_gb={self.memory_limit_gb}: can be enforced on Linux only; give null")

    @property
    def limits(self) -> Limits:
        """What one task may use."""
        return Limits(self.block_timeout_s, self.memory_limit_gb)

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Event]:
        workers = min(self.workers or cores(), len(tasks))
        if workers == 0:
            return iter(())
        threads = 1 if self.workers else max(1, cores() // workers)
        return supervise(work, tasks, workers, threads, self.limits)

    def warm_up(self, work: Work, tasks: int) -> None:
        _warm_up(min(self.workers or cores(), tasks), work.__module__)


def supervise(work: Work, tasks: Sequence[Task], workers: int, threads: int, limits: Limits) -> Iterator[Event]:
    """Runs tasks in at most so many worker processes with so many threads each; see `Execution.run`.

    A worker whose task exceeds its time is ended. The first step has a minute in any case: a new worker has to load
    compiled code.
    """
    waiting = deque(range(len(tasks)))
    busy: dict[Connection, _Worker] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                index = waiting.popleft()
                payload = cloudpickle.dumps((work, tasks[index]))
                worker = _take()
                while not worker.begin(index, threads, limits, payload):  # an idle one may have ended in the meantime
                    worker = _take()
                busy[worker.connection] = worker
            deadline = min(worker.deadline for worker in busy.values())
            patience = None if deadline == math.inf else max(0.0, deadline - time.monotonic())
            for connection in wait(list(busy), patience):
                worker = busy[connection]  # pyright: ignore[reportArgumentType]
                kind, value = worker.receive()
                if kind == "started":
                    worker.started = True
                    worker.extend(None if limits.seconds is None else max(limits.seconds, _PREPARATION_S))
                elif kind == "step":
                    worker.extend(limits.seconds)
                    yield Event(worker.index, value)
                else:
                    del busy[worker.connection]
                    if kind != "died":
                        _give_back(worker)
                    elif worker.served and not worker.started:  # it was ending while it was handed the task
                        waiting.appendleft(worker.index)
                        continue
                    if kind == "fatal":
                        raise value
                    yield Event(worker.index, ended=True, failure=value)
            now = time.monotonic()
            for worker in [w for w in busy.values() if w.deadline <= now]:
                if worker.connection.poll():
                    continue  # it answered in the last moment
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
            env={**os.environ, **dict.fromkeys(_THREAD_VARIABLES, "1"), "PYTHONPATH": path},
            start_new_session=True,
            **options,
        )
        there.close()
        self.index = -1
        self.deadline = math.inf
        self.served = False
        """Whether it has ended a task before this one."""
        self.started = False
        """Whether it has begun with this one."""

    def begin(self, index: int, threads: int, limits: Limits, payload: bytes) -> bool:
        """Hands it a task; False where the process is no longer there."""
        self.index = index
        self.deadline = math.inf
        self.started = False
        try:
            self.connection.send((sys.path, threads, (limits, payload)))
        except OSError:
            self.end()
            return False
        return True

    def preload(self, module: str) -> None:
        """Has it import a module; nothing is said of how that ends."""
        with contextlib.suppress(OSError):
            self.connection.send((sys.path, 1, module))

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
        """Ends the process without asking it."""
        with contextlib.suppress(OSError):
            self.connection.close()
        # One that has closed its pipe is on its way out: give it the time to leave its own exit code.
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(0.1)
            self._end_children()
            return
        self._end_children()
        self.process.kill()
        self.process.wait()

    def _end_children(self) -> None:
        """Ends what the worker started: its session is of its own, and outlives it."""
        if sys.platform != "win32":
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)


def _describe_exit(code: int) -> str:
    if code >= 0:
        return f"ended itself with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    hint = "; the system may have run out of memory" if name == "SIGKILL" else ""
    return f"was ended by {name}{hint}"


_idle: dict[int, list[_Worker]] = {}
"""By process: workers of another one, that this one was forked from, are not ours."""
_lock = threading.Lock()


def _take() -> _Worker:
    """An idle worker, else a new one."""
    with _lock:
        kept = _idle.setdefault(os.getpid(), [])
        while kept:
            worker = kept.pop()
            if worker.process.poll() is None:
                return worker
            worker.end()
    return _Worker()


def _give_back(worker: _Worker) -> None:
    worker.served = True
    with _lock:
        _idle.setdefault(os.getpid(), []).append(worker)


def _warm_up(workers: int, module: str) -> None:
    """Starts workers that are not there yet; they import the module while this process does other things."""
    with _lock:
        kept = _idle.setdefault(os.getpid(), [])
        new = [_Worker() for _ in range(workers - len(kept))]
        kept += new
    for worker in new:
        worker.preload(module)


@atexit.register
def end_idle() -> None:
    """Ends the workers that wait for another run, and gives back their memory."""
    for worker in _idle.get(os.getpid(), ()):
        worker.end()
    _idle.clear()
