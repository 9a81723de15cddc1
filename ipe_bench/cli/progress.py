"""Progress of a job: a bar with rate and time left on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from ipe_bench.basics.errors import shortened
from ipe_bench.runs.schedule import Progress, Watcher

LINE_EVERY_S = 10.0


@contextmanager
def shown_progress(title: str) -> Iterator[Watcher]:
    """Yields what `compute` is to call. Warnings of ipe-bench are shown above the bar meanwhile."""
    console = Console(stderr=True, highlight=False)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=10),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
    )
    bar = Bar(*columns, console=console, disable=not console.is_terminal)
    line = bar.add_task(shortened(title, max(30, console.width - 80)), total=None, state="")
    spoken = time.monotonic()

    def watch(progress: Progress) -> None:
        nonlocal spoken
        state = _state(progress)
        # A job without estimators to run still has its truth to store: then blocks stand in for trials.
        total, done = (progress.total, progress.trials) if progress.total else (progress.tasks, progress.done)
        bar.update(line, total=total or 1, completed=done if total else 1, state=state)
        if not console.is_terminal and (progress.done == progress.tasks or time.monotonic() - spoken >= LINE_EVERY_S):
            spoken = time.monotonic()
            console.print(f"{title}: {state}", markup=False, soft_wrap=True)

    logger, handler = logging.getLogger("ipe_bench"), logging.Handler(logging.WARNING)
    # Through the console that draws the bar, so that neither spoils the other.
    handler.emit = lambda record: console.print(f"ipe-bench: {record.getMessage()}", markup=False, soft_wrap=True)
    logger.addHandler(handler)
    try:
        with bar:
            yield watch
    finally:
        logger.removeHandler(handler)


def _state(progress: Progress) -> str:
    """How far a job is, with the rate and the forecast once there are any."""
    if not progress.tasks:
        return "nothing left to compute"
    state = f"block {progress.done}/{progress.tasks}"
    if progress.failures:
        state += f", {len(progress.failures)} failed"
    if progress.began is None:
        return f"{state}, compiling, once"
    seconds = time.monotonic() - progress.began
    if rate := progress.trials / max(seconds, 1e-9):
        state += f", {rate:.0f} estimates/s" if rate >= 10 else f", {rate:.2g} estimates/s"
    if 0 < progress.done < progress.tasks:
        state += f", {timedelta(seconds=round(seconds * (progress.tasks / progress.done - 1)))} left"
    return state
