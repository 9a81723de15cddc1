"""A progress bar over the blocks of a job; plain lines where the output is no terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from ipe_bench.api import Progress, Watcher


@contextmanager
def shown_progress(title: str) -> Iterator[Watcher]:
    """Yields what `compute` is to call after each task."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("blocks"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=console, disable=not console.is_terminal) as bar:
        line = bar.add_task(title, total=None)

        def watch(progress: Progress) -> None:
            bar.update(line, total=progress.tasks, completed=progress.done)
            if not console.is_terminal and progress.done == progress.tasks:
                done = f"{progress.tasks} blocks computed" if progress.tasks else "nothing left to compute"
                console.print(f"{title}: {done}", highlight=False)

        yield watch
