"""The process that a task runs in: `python -m ipe_bench.runs.worker FD`.

It imports next to nothing before it listens, computes with one thread in BLAS, holds itself to the
memory limit of a task, and ends when its parent ends.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import sys
import threading
import warnings
from multiprocessing.connection import Connection
from typing import Any


def main(handle: int) -> None:
    # Ctrl-C is the parent's business: it ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Where numbers overflow, the statuses of trials say so.
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    connection = _connection(handle)
    messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
    # Reading in a thread, so that the end of the parent is noticed in the middle of a task.
    threading.Thread(target=_listen, args=(connection, messages), daemon=True).start()
    imported: dict[str, Any] = {}
    while True:
        path, threads, memory_gb, payload = messages.get()
        if _edited(imported):
            os._exit(0)  # the task goes to a process that imports what the files say now
        sys.path[:] = path
        os.environ["IPE_BENCH_THREADS"] = str(threads)
        connection.send(_perform(connection, memory_gb, payload, imported))


def _listen(connection: Connection, messages: queue.SimpleQueue[Any]) -> None:
    while True:
        try:
            messages.put(connection.recv())
        except (EOFError, OSError):
            # The parent is gone. This session holds nothing but this process and those that a task
            # has started.
            if sys.platform != "win32" and os.getsid(0) == os.getpid():
                os.killpg(0, signal.SIGKILL)
            os._exit(0)


def _edited(imported: dict[str, Any]) -> bool:
    """Tells whether a file is not what it was when it was imported."""
    return any(_written(file) != written for file, written in imported.items())


def _note_imports(imported: dict[str, Any]) -> None:
    """Adds the files of modules that may be edited while this process waits for a task."""
    from ipe_bench.basics.definitions import is_installed

    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is not None and file not in imported and not is_installed(name):
            imported[file] = _written(file)


def _written(file: str) -> tuple[int, int] | None:
    try:
        about = os.stat(file)
    except OSError:
        return None
    return about.st_mtime_ns, about.st_size


def _perform(
    connection: Connection, memory_gb: float | None, payload: bytes, imported: dict[str, Any]
) -> tuple[str, Any]:
    """Does one task; returns the last message about it."""
    from ipe_bench.runs.execution import FATAL, Failure

    try:
        _limit_memory(memory_gb)
        work, task = pickle.loads(payload)
        _note_imports(imported)
        connection.send(("started", None))
        for step in work(task):
            connection.send(("step", step))
        _note_imports(imported)
    except FATAL as error:
        return "fatal", error
    except BaseException as error:  # sys.exit() in an estimator, too, fails that task only
        return "ended", Failure.of(error)
    return "ended", None


def _limit_memory(memory_gb: float | None) -> None:
    """Has every allocation of this process beyond the limit, in 1e9 bytes, end in a MemoryError."""
    if sys.platform.startswith("linux"):
        import resource

        # Data, not address space: compiled code and thread pools reserve far more addresses than
        # they use.
        _, most = resource.getrlimit(resource.RLIMIT_DATA)
        limit = most if memory_gb is None else int(memory_gb * 1e9)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, most))


def _connection(handle: int) -> Connection:
    if sys.platform == "win32":
        from multiprocessing.connection import PipeConnection

        return PipeConnection(handle)
    return Connection(handle)


if __name__ == "__main__":
    main(int(sys.argv[1]))
