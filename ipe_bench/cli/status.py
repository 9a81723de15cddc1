"""`ipe-bench status DIR...`: what is done, missing, failed and stale in directories of results."""

from __future__ import annotations

from collections.abc import Sequence

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import say, show
from ipe_bench.report.table import Table, texts, words
from ipe_bench.runs.bundles import opened
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.results import CellState, Results, require_results


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
    cells = [cell for cell in results.cells if verbose or not cell.complete or cell.stale]
    if cells:
        show([_table(directory, cells)])
    verdict = "not complete; the same command as before computes what is missing, failed or damaged"
    if not results.problems:
        estimates = [cell for cell in results.cells if cell.names["estimator"] != TRUTH]
        trials = sum(cell.done for cell in estimates)
        verdict = f"complete: {len(estimates)} scenarios under an estimator, {trials} trials"
    say(*(results.problems or results.stale), f"{directory}: {verdict}")


def _table(directory: str, cells: Sequence[CellState]) -> Table:
    names = [cell.names["estimator"] for cell in cells]
    columns = [
        words("scenario", [cell.title for cell in cells]),
        words("estimator", ["(truth)" if name == TRUTH else name for name in names]),
        texts("done", [f"{cell.done} of {cell.expected or cell.done}" for cell in cells]),
        *(
            texts(count, [str(getattr(cell, count) or "") for cell in cells])
            for count in ("missing", "failed", "stale")
        ),
    ]
    return Table("status", directory, "", columns, grouped=1)
