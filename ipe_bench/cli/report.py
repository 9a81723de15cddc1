"""`ipe-bench report DIR...`: tables, figures and report from what is stored."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import NAMES, console, places_and_keys, print_problems, say
from ipe_bench.report.run import begin_report
from ipe_bench.report.style import PAGE, Which
from ipe_bench.runs.bundles import BUNDLES, is_bundle, opened
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.results import require_results

if TYPE_CHECKING:
    from ipe_bench.statistics.collect import Collection

_KEYS = {"output": str, "figures": str, "formats": str}
_PAPER = {"output": str, "paper": NAMES, "columns": NAMES, "width": float}
"""Keys of tables and figures for a paper."""


def main(arguments: Sequence[str]) -> int:
    """Writes the report on these folders, or bundles; exit code 1 where something that was asked for is missing."""
    for_paper = any(word.startswith(("paper=", "columns=", "width=")) for word in arguments)
    named, keys = places_and_keys("report", arguments, _PAPER if for_paper else _KEYS)
    output = Path(keys["output"]) if "output" in keys else None
    if not named:
        raise UserError("report: name at least one directory of results, such as outputs/paper")
    if output is None and (bundles := [name for name in named if is_bundle(name)]):
        raise UserError(f"report: {bundles[0]}: is a bundle; say where the report goes with output=DIR")
    if output is None and len(named) > 1 and not for_paper:
        raise UserError("report: several directories need output=DIR, as the report on all is not that of the first")
    with opened(named, None if output is None else output / BUNDLES) as folders:
        require_results(folders)
        if for_paper:
            return _paper(folders, keys)
        report = begin_report(folders, output, figures=keys.get("figures", "main"), formats=keys.get("formats", PAGE))
        collection = report.begun.collection
        _print_table(report.begun.summary, collection)
        report.write_unless_current()
        print_problems([*collection.problems, *collection.stale])
        _print_places(report.output)
        return 1 if collection.problems else 0


def show_command(output: Path, cells: Mapping[str, str], figures: Which, formats: tuple[str, ...]) -> int:
    """Writes the report on all that the folder holds, and prints what belongs to these cells; the exit code.

    `cells` has a line for people by key; where it is empty, everything is printed.
    """
    report = begin_report([output], figures=figures, formats=formats)
    collection, rows = report.begun.collection, report.begun.summary
    others = sum(cell.key not in cells and cell.label != TRUTH for cell in collection.current) if cells else 0
    shown = collection
    if others:
        from ipe_bench.statistics.analysis import Begun
        from ipe_bench.statistics.collect import collect

        shown = collect([output], cells.keys())
        rows = Begun(shown).summary
    _print_table(rows, shown)
    report.write_unless_current()
    # What is wrong with a file or a folder may concern anybody; what other commands lack does not.
    of_cells = [p for p in collection.problems if p.startswith(("missing: ", "failed: "))]
    elsewhere = [p for p in of_cells if cells and not any(line in p for line in cells.values())]
    print_problems([p for p in collection.problems if p not in elsewhere])
    if elsewhere:
        counted = _counted(len(elsewhere), "problem")
        print_problems([f"{output}: {counted} of other commands; `ipe-bench status {output}` lists them"])
    _print_places(output)
    if others:
        print(f"Here too  {_counted(others, 'result')} of other commands; `ipe-bench report {output}` shows all")
    return 1 if collection.problems else 0


def _print_table(rows: Sequence[Mapping[str, Any]], collection: Collection) -> None:
    from ipe_bench.report.terminal import render

    totals = []
    if any(row["noise"] == "certified" for row in rows):
        from ipe_bench.report.tables import certified_tables

        totals = [table for table in certified_tables(collection) if table.whole]
    out = console()
    out.print(render(rows, totals, out.width))
    sys.stdout.flush()


def _print_places(output: Path) -> None:
    figures = f"\nFigures  {output / 'figures'}" if any(output.glob("figures/*.png")) else ""
    say(
        f"\nSummary  {output / 'summary.csv'}\nTables   {output / 'tables'}{figures}\nReport   {output / 'report.html'}"
    )


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _paper(folders: Sequence[Path], keys: Mapping[str, Any]) -> int:
    """Writes tables and figures as a paper wants them; exit code 1 where data are missing."""
    from ipe_bench.plugins.extensions import use_statistics
    from ipe_bench.report.paper import export
    from ipe_bench.statistics import analyse

    if not keys.get("paper"):
        raise UserError("paper=: name tables and figures, such as paper=overview,headline")
    chosen = {key: keys[key] for key in ("columns", "width") if key in keys}
    faults = use_statistics()
    analysis = analyse(folders)
    analysis.collection.extra_problems += faults
    say(*map(str, export(analysis, Path(keys.get("output", folders[0] / "paper")), keys["paper"], **chosen)))
    print_problems([*analysis.problems, *analysis.stale])
    return 1 if analysis.problems else 0
