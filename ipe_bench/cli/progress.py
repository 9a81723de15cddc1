"""Progress of a job: a bar with rate and time left on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.progress import Task as BarTask
from rich.table import Column
from rich.text import Text

from ipe_bench.runs.schedule import Progress, Watcher

LINE_EVERY_S = 10.0


@contextmanager
def shown_progress(title: str) -> Iterator[Watcher]:
    """Yields what `compute` is to call. Warnings of ipe-bench are shown above the bar meanwhile."""
    console = Console(stderr=True, highlight=False)
    handler = _Lines(console)
    logger = logging.getLogger("ipe_bench")
    logger.addHandler(handler)
    try:
        if console.is_terminal:
            with _bar(console) as bar:
                yield _bar_watcher(bar, title)
        else:
            yield _line_watcher(console, title)
    finally:
        logger.removeHandler(handler)


class _Lines(logging.Handler):
    """Prints warnings through the console that also draws the bar, so that neither spoils the other."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.WARNING)
        self.console = console

    def emit(self, record: logging.LogRecord) -> None:
        self.console.print(f"ipe-bench: {record.getMessage()}", markup=False, soft_wrap=True)


class _Title(ProgressColumn):
    """What gives way where the terminal is narrow; the numbers stay whole."""

    def render(self, task: BarTask) -> Text:
        return Text(task.description, no_wrap=True, overflow="ellipsis")


def _bar(console: Console) -> Bar:
    columns = (
        _Title(),
        BarColumn(bar_width=10, table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[state]}", table_column=Column(no_wrap=True)),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
    )
    return Bar(*columns, console=console)


def _bar_watcher(bar: Bar, title: str) -> Watcher:
    line = bar.add_task(title, total=None, state="")

    def watch(progress: Progress) -> None:
        state = _state(progress) if progress.tasks else "nothing left to compute"
        # A job without estimators to run still has its truth to store: then blocks stand in for trials.
        total, done = (progress.total, progress.trials) if progress.total else (progress.tasks, progress.done)
        bar.update(line, total=total or 1, completed=done if total else 1, state=state)

    return watch


def _state(progress: Progress) -> str:
    """How far a job is, with the rate and the forecast once there are any."""
    failed = f", {len(progress.failures)} failed" if progress.failures else ""
    rate = f", {_rounded(progress.rate)} estimates/s" if progress.rate else ""
    left = "" if progress.seconds_left is None else f", {duration(progress.seconds_left)} left"
    return f"block {progress.done}/{progress.tasks}{failed}" + (
        ", compiling, once" if progress.preparing else rate + left
    )


def _line_watcher(console: Console, title: str) -> Watcher:
    began = spoken = time.monotonic()

    def say(text: str) -> None:
        console.print(f"{title}: {text}", markup=False, soft_wrap=True)

    def watch(progress: Progress) -> None:
        nonlocal spoken
        now = time.monotonic()
        if not progress.tasks:
            say("nothing left to compute")
        elif progress.done == progress.tasks:
            failed = f", {len(progress.failures)} failed" if progress.failures else ""
            blocks = "1 block" if progress.tasks == 1 else f"{progress.tasks} blocks"
            say(f"{blocks}{failed} in {duration(now - began)}, {_rounded(progress.rate)} estimates/s")
        elif now - spoken >= LINE_EVERY_S:
            spoken = now
            say(_state(progress))

    return watch


def _rounded(rate: float) -> str:
    return f"{rate:.0f}" if rate >= 10 else f"{rate:.2g}"


def duration(seconds: float) -> str:
    """A time for people: 2.5 s, 3 min 20 s, 5 h 07 min."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"
