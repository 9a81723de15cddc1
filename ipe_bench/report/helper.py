"""A second process that draws, started while there is other work to do; both of its ends, and no library that draws.

It is handed one figure at a time and hands back the content of its files: it writes nothing anywhere, and ends with the
process that started it, however that ends.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import queue
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import IO, Any, TypeVar

from ipe_bench.basics.machine import cores

Told = TypeVar("Told")
_LOADED = (
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "ipe_bench.report.extensions",
    "ipe_bench.report.figures.gallery",
)
_LENGTH = struct.Struct(">Q")


class Helper:
    """The second process as the first sees it: none until it is started, and none where there is one core alone."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def started(self) -> bool:
        return self._process is not None

    def start(self) -> None:
        """Starts it, unless it is; it loads what it needs to draw meanwhile."""
        if self._process is not None or cores() < 2:
            return
        # Not forked, since this process may have threads, and not by multiprocessing, which would run the user's
        # script again.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "PYTHONSAFEPATH": "1"}
        command = [sys.executable, "-c", f"from {__name__} import serve; serve()"]
        pipe, quiet = subprocess.PIPE, subprocess.DEVNULL
        with contextlib.suppress(OSError):
            self._process = subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, stderr=quiet)

    def start_when_there_is_work(self, watch: Callable[[Any], Told]) -> Callable[[Any], Told]:
        """What watches a run, made to start the process as soon as it hears that the run has anything to compute."""

        def watching(progress: Any) -> Told:
            if progress.tasks:
                self.start()
            return watch(progress)

        return watching

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """What the function comes to in the second process.

        Raises:
            ConnectionError: it could not be done there, for whatever reason; or there is no second process any more.
        """
        try:
            assert self._process is not None
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            # Folders of plugins may have come to be searched since the start.
            _send(self._process.stdin, pickle.dumps((sys.path, pickle.dumps((function, arguments)))))
            done, result = pickle.loads(_receive(self._process.stdout))
        except Exception as error:
            raise ConnectionError("the second process is gone") from error
        if not done:
            raise ConnectionError(f"the second process failed: {result}")
        return result

    def stop(self) -> None:
        """Ends it at once, which leaves nothing behind."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]


_helper: ContextVar[Helper | None] = ContextVar("helper", default=None)


@contextlib.contextmanager
def drawing_help() -> Iterator[Helper]:
    """The helper of whatever is drawn meanwhile, which ends with the outermost of these."""
    known = _helper.get()
    if known is not None:
        yield known
        return
    helper = Helper()
    token = _helper.set(helper)
    try:
        yield helper
    finally:
        _helper.reset(token)
        helper.stop()


# The other end -------------------------------------------------------------------------------------------------------


def serve() -> None:
    """Does what it is asked until nobody can ask any more."""
    # Ctrl-C reaches this process too; what it means is for the one that started it to say.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asked: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, asked), daemon=True).start()
    # What plugins print must not come between the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    _prepare()
    while True:
        path, content = pickle.loads(asked.get())
        sys.path[:] = path
        _send(answers, _answer(content))


def _listen(questions: IO[bytes], asked: queue.SimpleQueue[bytes]) -> None:
    """Takes what comes, while something is drawn as well: the end of it is the end of the process."""
    try:
        while True:
            asked.put(_receive(questions))
    finally:
        os._exit(0)


def _prepare() -> None:
    """Loads what every figure needs."""
    for name in _LOADED:
        importlib.import_module(name)
    # What is loaded stays: the collector need not look through it after every figure.
    gc.freeze()


def _answer(content: bytes) -> bytes:
    try:
        function, arguments = pickle.loads(content)
        return pickle.dumps((True, function(*arguments)))
    except Exception as error:
        return pickle.dumps((False, repr(error)))


def _send(pipe: IO[bytes], content: bytes) -> None:
    pipe.write(_LENGTH.pack(len(content)) + content)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> bytes:
    (length,) = _LENGTH.unpack(_whole(pipe, _LENGTH.size))
    return _whole(pipe, length)


def _whole(pipe: IO[bytes], length: int) -> bytes:
    content = pipe.read(length)
    if len(content) < length:
        raise EOFError
    return content
