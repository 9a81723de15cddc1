"""`ipe-bench status DIR...`: what is done, missing, failed and stale in directories of results."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console
from ipe_bench.runs.store import TRUTH
from ipe_bench.statistics.inventory import Inventory, take_inventory, title


def main(arguments: Sequence[str]) -> int:
    """One table per directory; exit code 1 where anything that was asked for is not there."""
    if not arguments:
        raise UserError("status: name at least one directory of results, such as outputs/paper")
    inventories = [(directory, take_inventory(directory)) for directory in arguments]
    for directory, inventory in inventories:
        _show(directory, inventory)
    return 0 if all(inventory.complete for _, inventory in inventories) else 1


def _show(directory: str, inventory: Inventory) -> None:
    out = console()
    table = Table(title=directory, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for heading in ("scenario", "estimator", "done", "missing", "failed", "stale"):
        table.add_column(heading, justify="left" if heading in ("scenario", "estimator") else "right", overflow="fold")
    for cell in inventory.cells:
        label = "(truth)" if cell.names["estimator"] == TRUTH else cell.names["estimator"]
        numbers = (str(n) if n else "" for n in (cell.missing, cell.failed, cell.stale))
        table.add_row(title(cell.names), label, f"{cell.done} of {cell.expected or cell.done}", *numbers)
    out.print(table)
    for path in inventory.damaged:
        out.print(f"damaged: {path}; the next run sets it aside and computes it again", markup=False)
    for cell in inventory.cells:
        for message in cell.messages:
            out.print(f"failed: {cell.names['estimator']} on {title(cell.names)}: {message}", markup=False)
    if inventory.complete:
        out.print("complete")
    else:
        out.print("not complete: the same command as before computes what is missing or failed")
