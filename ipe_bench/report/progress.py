"""Shows how far a computation is: as a bar in a terminal, as a line in a notebook, and nowhere else
unless asked to."""

from __future__ import annotations

import contextlib
import itertools
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from datetime import timedelta
from typing import TYPE_CHECKING, Any, Literal

from ipe_bench.basics.errors import shortened

if TYPE_CHECKING:
    from ipe_bench.runs.schedule import Progress, Watcher

Shows = bool | Literal["lines"]
"""Whether a terminal or a notebook shows progress; "lines" prints a line now and then elsewhere."""
Tell = Callable[[float, float, str], None]
"""Takes how much is done, of how much, and a few words on it."""
_LINE_EVERY_S = 10.0
"""Seconds between lines of progress in a file."""
_NOTEBOOK_EVERY_S = 0.5
"""Seconds between changes of a notebook's line, and before the first."""


@contextlib.contextmanager
def watching(title: str, *, lines: bool = False, off: bool = False) -> Iterator[Watcher]:
    """Yields a callback of `compute`; `lines` prints a line now and then on a stderr that is no
    terminal."""
    with _telling(title, lines=lines, kept=lines, off=off) as tell:

        def watch(progress: Progress) -> None:
            if progress.total:
                tell(progress.trials, progress.total, _state(progress))
            else:
                # A job without estimators to run still has its truth to store.
                tell(progress.done, progress.tasks, _state(progress))

        yield watch


@contextlib.contextmanager
def counting(
    title: str, total: int, progress: Shows = True
) -> Iterator[Callable[[str], Callable[[str], None]]]:
    """Yields a callback that is given the name of each of `total` pieces of work before it begins,
    and returns one that is told how far that is."""
    begun = itertools.count(0)
    with _telling(title, lines=progress == "lines", kept=False, off=not progress) as tell:

        def begin(name: str) -> Callable[[str], None]:
            done = next(begun)
            tell(done, total, name)
            return lambda state: tell(done, total, f"{name}: {state}")

        yield begin


def _telling(title: str, *, lines: bool, kept: bool, off: bool) -> AbstractContextManager[Tell]:
    """Yields a callback that shows progress in a notebook, in a terminal or, by `lines`,
    anywhere."""
    if _in_notebook() and not off:
        return _line_of_notebook(title)
    if lines or (not off and sys.stderr is not None and sys.stderr.isatty()):
        return _bar(title, lines=lines, kept=kept)
    return contextlib.nullcontext(lambda done, total, state: None)


def _in_notebook() -> bool:
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


@contextlib.contextmanager
def _line_of_notebook(title: str) -> Iterator[Tell]:
    """Shows a line that is empty again in the end, and that a computation of less than a moment
    never shows."""
    from IPython.display import display  # pyright: ignore[reportMissingImports]

    last = time.monotonic()
    shown = None

    def tell(done: float, total: float, state: str) -> None:
        nonlocal last, shown
        if time.monotonic() - last < _NOTEBOOK_EVERY_S:
            return
        last = time.monotonic()
        text = {"text/plain": f"{title}: {state}"}
        if shown is None:
            shown = display(text, raw=True, display_id=True)
        else:
            shown.update(text, raw=True)

    try:
        yield tell
    finally:
        if shown is not None:
            shown.update({"text/plain": ""}, raw=True)


@contextlib.contextmanager
def _bar(title: str, *, lines: bool, kept: bool) -> Iterator[Tell]:
    """Shows a bar on stderr, with warnings of ipe-bench above it; one that is `kept` stays there.
    Where stderr is no terminal, `lines` prints a line now and then."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    from ipe_bench.report.screen import Screen

    console = Screen(stderr=True)
    name = TextColumn("{task.description}", markup=False)
    state_of = TextColumn("{task.fields[state]}", markup=False)
    options: dict[str, Any] = {
        "console": console,
        "disable": not console.is_terminal,
        "transient": not kept,
    }
    bar = Bar(name, BarColumn(10), state_of, TimeElapsedColumn(), **options)
    letters = max(30, console.width - 80)
    line = bar.add_task(shortened(title, letters), total=None, state="")
    spoken = time.monotonic()

    def tell(done: float, total: float, state: str) -> None:
        nonlocal spoken
        bar.update(line, total=total or 1, completed=done if total else 1, state=state)
        due = done >= total or time.monotonic() - spoken >= _LINE_EVERY_S
        if lines and due and not console.is_terminal:
            spoken = time.monotonic()
            console.print(f"{title}: {state}", soft_wrap=True)

    logger = logging.getLogger("ipe_bench")
    handler = logging.Handler(logging.WARNING)
    # Through the console that draws the bar, so that neither spoils the other.
    handler.emit = lambda record: console.print(f"ipe-bench: {record.getMessage()}", soft_wrap=True)
    logger.addHandler(handler)
    try:
        # Older versions of rich end even a bar that is not shown with an empty line.
        with bar if console.is_terminal else contextlib.nullcontext():
            yield tell
    finally:
        logger.removeHandler(handler)


def _state(progress: Progress) -> str:
    """Says how far a job is, with the rate and the forecast once there are any."""
    if not progress.tasks:
        return "all trials are stored"
    state = f"block {progress.done}/{progress.tasks}"
    if progress.failures:
        state += f", {len(progress.failures)} failed"
    if progress.began is None:
        return f"{state}, compiling, once"
    seconds = time.monotonic() - progress.began
    rate = progress.trials / max(seconds, 1e-9)
    if rate:
        state += f", {rate:.0f} estimates/s" if rate >= 10 else f", {rate:.2g} estimates/s"
    if 0 < progress.done < progress.tasks:
        left = seconds * (progress.tasks / progress.done - 1)
        state += f", {timedelta(seconds=round(left))} left"
    return state
