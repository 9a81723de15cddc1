"""`ipe-bench status DIR...`: what is done, missing, failed and stale in directories of results."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console
from ipe_bench.runs.results import Results, require_results
from ipe_bench.runs.store import TRUTH

_COUNTS = ("missing", "failed", "stale")


def main(arguments: Sequence[str]) -> int:
    """One table per directory; exit code 1 where anything that was asked for is not there, or anything is damaged."""
    if not arguments:
        raise UserError("status: name at least one directory of results, such as outputs/paper")
    require_results(arguments)
    found = [Results.read([directory]) for directory in arguments]
    for directory, results in zip(arguments, found, strict=True):
        _show(directory, results)
    return 1 if any(results.problems for results in found) else 0


def _show(directory: str, results: Results) -> None:
    out = console()
    table = Table(title=directory, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for heading in ("scenario", "estimator"):
        table.add_column(heading, overflow="fold")
    for heading in ("done", *_COUNTS):
        table.add_column(heading, justify="right", overflow="fold")
    for cell in results.cells:
        label = "(truth)" if cell.names["estimator"] == TRUTH else cell.names["estimator"]
        counts = (str(getattr(cell, name) or "") for name in _COUNTS)
        table.add_row(cell.title, label, f"{cell.done} of {cell.expected or cell.done}", *counts)
    out.print(table)
    for problem in results.problems:
        out.print(problem, markup=False, soft_wrap=True)
    if results.problems:
        out.print("not complete: the same command as before computes what is missing, failed or damaged")
    else:
        out.print("complete")
