"""Ctrl-C: before there is any work it ends the process at once, later it is raised, and always it leaves one line."""

from __future__ import annotations

import os
import signal
import threading
from typing import Any

EXIT_CODE = 130
STOPPED = "stopped; what was computed is kept, and the same command goes on from there"

_state = {"came": False, "working": False}


def install() -> None:
    """Listens to Ctrl-C from here on, unless somebody else does or it is switched off."""
    _state.update(came=False, working=False)
    here = threading.current_thread() is threading.main_thread()
    if here and signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _listen):
        signal.signal(signal.SIGINT, _listen)


def begin_work() -> None:
    """From here on there is something to be put in order before the process ends."""
    _state["working"] = True


def came() -> bool:
    """Whether there was a Ctrl-C: libraries that are interrupted while they load raise other errors for it."""
    return _state["came"]


def _listen(*_: Any) -> None:
    _state["came"] = True
    if _state["working"]:
        raise KeyboardInterrupt
    os.write(2, f"ipe-bench: {STOPPED}\n".encode())
    os._exit(EXIT_CODE)
