"""`ipe-bench status DIR...`: what is done, missing, failed and stale in directories of results."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console
from ipe_bench.runs.bundles import opened
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.results import CellState, Results, require_results

_COUNTS = ("missing", "failed", "stale")


def main(arguments: Sequence[str], verbose: bool = False) -> int:
    """A line per directory that is complete, else a table; exit code 1 where anything is missing or damaged."""
    if not arguments:
        raise UserError("status: name at least one directory of results, such as outputs/paper")
    with opened(arguments) as folders:
        require_results(folders)
        found = [Results.read([folder]) for folder in folders]
        for folder, results in zip(folders, found, strict=True):
            # A bundle's folders are called as they were, not as where they are unpacked.
            _show(str(folder) if str(folder) in arguments else folder.name, results, verbose)
        return 1 if any(results.problems for results in found) else 0


def _show(directory: str, results: Results, verbose: bool) -> None:
    """What is not complete, or everything where verbose."""
    out = console()
    cells = [cell for cell in results.cells if verbose or not cell.complete or cell.stale]
    if cells:
        out.print(_table(directory, cells))
    for problem in results.problems:
        out.print(problem, markup=False, soft_wrap=True)
    verdict = "not complete; the same command as before computes what is missing, failed or damaged"
    estimates = [cell for cell in results.cells if cell.names["estimator"] != TRUTH]
    for line in results.stale if not results.problems else ():
        out.print(line, markup=False, soft_wrap=True)
    if not results.problems:
        trials = sum(cell.done for cell in estimates)
        verdict = f"complete: {len(estimates)} scenarios under an estimator, {trials} trials"
    out.print(f"{directory}: {verdict}", markup=False, soft_wrap=True)


def _table(directory: str, cells: Sequence[CellState]) -> Table:
    table = Table(title=Text(directory), title_justify="left", title_style="bold", box=None, pad_edge=False)
    for heading in ("scenario", "estimator"):
        table.add_column(heading, overflow="fold")
    for heading in ("done", *_COUNTS):
        table.add_column(heading, justify="right", overflow="fold")
    said = ""
    for cell in cells:
        scenario, said = "" if cell.title == said else cell.title, cell.title
        label = "(truth)" if cell.names["estimator"] == TRUTH else cell.names["estimator"]
        counts = (str(getattr(cell, name) or "") for name in _COUNTS)
        table.add_row(Text(scenario), Text(label), f"{cell.done} of {cell.expected or cell.done}", *counts)
    return table
