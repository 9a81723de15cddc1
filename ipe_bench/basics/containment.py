"""Calling code that may do anything: what it does to this process is undone, and what it raises is an exception.

What it may do to arrays and components that others use as well is left to `estimators.private`.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import random
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from ipe_bench.basics.errors import describe_exception


class Escaped(Exception):
    """What a part raised was an exception that ends programs, such as a KeyboardInterrupt of its own."""


@contextmanager
def contained() -> Iterator[None]:
    """Undoes what the code inside does to random states, the working folder, warnings, signal handlers and the
    floating-point unit; NumPy's warnings are off inside.

    Raises:
        KeyboardInterrupt: the user pressed Ctrl-C, whatever the code inside made of it.
        Escaped: the code inside raised an exception of its own that is not an `Exception`; SystemExit and MemoryError
            are left as they are.
    """
    with ExitStack() as stack:
        interrupted = stack.enter_context(_interrupts_noted())
        for keep in (_random_states, _working_folder, _warnings, _floating_point_unit):
            stack.enter_context(keep())
        stack.enter_context(np.errstate(all="ignore"))
        try:
            yield
        except BaseException as error:
            if interrupted:
                raise KeyboardInterrupt from error
            if isinstance(error, Exception | SystemExit):
                raise
            raise Escaped(describe_exception(error)) from error
        if interrupted:
            raise KeyboardInterrupt


@contextmanager
def _interrupts_noted() -> Iterator[list[int]]:
    """A list that is no longer empty once the user has pressed Ctrl-C; handlers of signals are put back."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted  # where Python delivers no signals
        return
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    handler = before[signal.SIGINT]

    def note(number: int, frame: Any) -> Any:
        noted.append(number)
        assert callable(handler)
        return handler(number, frame)

    if callable(handler):
        signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        for number, previous in before.items():
            if previous is not None:  # else it is not Python's
                signal.signal(number, previous)


@contextmanager
def _random_states() -> Iterator[None]:
    shared: Any = np.random  # NumPy's stubs do not know the two functions below
    generator, state, python_state = shared.get_bit_generator(), shared.get_state(legacy=False), random.getstate()
    try:
        yield
    finally:
        shared.set_bit_generator(generator)
        shared.set_state(state)
        random.setstate(python_state)


@contextmanager
def _working_folder() -> Iterator[None]:
    try:
        folder = os.getcwd()
    except OSError:
        folder = None  # it has been deleted
    try:
        yield
    finally:
        if folder is not None:
            with contextlib.suppress(OSError):
                os.chdir(folder)


@contextmanager
def _warnings() -> Iterator[None]:
    """Not `catch_warnings`, after which every warning that is shown once is shown again."""
    filters, entries = warnings.filters, list(warnings.filters)
    functions = warnings.showwarning, warnings.formatwarning
    try:
        yield
    finally:
        if warnings.filters is not filters or list(filters) != entries:
            warnings.filters = filters
            warnings.resetwarnings()
            filters.extend(entries)  # type: ignore[attr-defined]
        warnings.showwarning, warnings.formatwarning = functions


@contextmanager
def _floating_point_unit() -> Iterator[None]:
    """Rounding mode, traps, and what happens to denormal numbers."""
    get, put = _environment_functions()
    environment = ctypes.create_string_buffer(256)
    kept = get(environment) == 0
    try:
        yield
    finally:
        if kept:
            put(environment)


@functools.cache
def _environment_functions() -> tuple[Callable[[Any], int], Callable[[Any], int]]:
    try:
        library = ctypes.CDLL(None if os.name == "posix" else "ucrtbase")
        return library.fegetenv, library.fesetenv
    except (OSError, AttributeError):
        return (lambda _: 1), (lambda _: 1)
