"""`ipe-bench report DIR...`: tables, figures and report from what is stored."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, paper
from ipe_bench.report.choice import PAGE, Which, file_formats, which_figures
from ipe_bench.runs.bundles import BUNDLES, is_bundle, opened
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.results import require_results

if TYPE_CHECKING:
    from ipe_bench.statistics.analysis import Begun
    from ipe_bench.statistics.collect import Collection


def main(arguments: Sequence[str]) -> int:
    """Aggregates the directories, or bundles; the report goes to the first directory, or to output=DIR."""
    with unpacked(arguments) as words:
        return paper.main(words) if paper.asked_for(words) else _report(words)


@contextlib.contextmanager
def unpacked(words: Sequence[str]) -> Iterator[list[str]]:
    """The words with folders in place of bundles, which go below the report.

    Raises:
        UserError: there is a bundle and no folder for the report, or it is not whole.
    """
    bundles = [word for word in words if is_bundle(word)]
    outputs = [word.removeprefix("output=") for word in words if word.startswith("output=")]
    if bundles and not outputs:
        raise UserError(f"report: {bundles[0]}: is a bundle; say where the report goes with output=DIR")
    with opened(bundles, Path(outputs[0]) / BUNDLES if bundles else None) as folders:
        yield [*(word for word in words if word not in bundles), *map(str, folders)]


def _report(arguments: Sequence[str]) -> int:
    outputs = [a.removeprefix("output=") for a in arguments if a.startswith("output=")]
    asked = [a.removeprefix("figures=") for a in arguments if a.startswith("figures=")]
    named = [a.removeprefix("formats=") for a in arguments if a.startswith("formats=")]
    directories = [Path(a) for a in arguments if not a.startswith(("output=", "figures=", "formats="))]
    figures = which_figures(asked[-1] if asked else "main")
    formats = file_formats(named[-1] if named else PAGE)
    if not directories:
        raise UserError("report: name at least one directory of results, such as outputs/paper")
    if len(outputs) > 1:
        raise UserError(f"report: {' '.join(f'output={o}' for o in outputs)}: give one folder to write to")
    if len(directories) > 1 and not outputs:
        raise UserError("report: several directories need output=DIR, as the report on all is not that of the first")
    require_results(directories)
    from ipe_bench.report.stamp import made_from

    output = Path(outputs[0]) if outputs else directories[0]
    made = made_from(directories, output, figures, formats)
    begun = _begin(directories)
    _print_table(begun.summary, begun.collection)
    collection = _write(begun, output, made, figures, formats)
    for problem in (*collection.problems, *collection.stale):
        print(f"ipe-bench: {problem}", file=sys.stderr)
    _print_places(output)
    return 1 if collection.problems else 0


def show_command(
    output: Path, cells: Mapping[str, str], figures: Which = "main", formats: tuple[str, ...] = (PAGE,)
) -> int:
    """Writes the report on all that the folder holds, and prints what belongs to these cells; the exit code.

    `cells` has a line for people by key.
    """
    from ipe_bench.report.stamp import made_from

    made = made_from([output], output, figures, formats)
    begun = _begin([output])
    others = sum(cell.key not in cells and cell.label != TRUTH for cell in begun.collection.current)
    if others:
        _print_own_table(output, cells)
    else:
        _print_table(begun.summary, begun.collection)
    problems = _write(begun, output, made, figures, formats).problems
    # What is wrong with a file or a folder may concern anybody; what other commands lack does not.
    of_cells = [p for p in problems if p.startswith(("missing: ", "failed: "))]
    elsewhere = [p for p in of_cells if not any(line in p for line in cells.values())]
    for problem in [p for p in problems if p not in elsewhere]:
        print(f"ipe-bench: {problem}", file=sys.stderr)
    if elsewhere:
        told = f"{_counted(len(elsewhere), 'problem')} of other commands; `ipe-bench status {output}` lists them"
        print(f"ipe-bench: {output}: {told}", file=sys.stderr)
    _print_places(output)
    more = f"Here too  {_counted(others, 'result')} of other commands; `ipe-bench report {output}` shows all\n"
    print(more if others else "", end="")
    return 1 if problems else 0


def _print_own_table(output: Path, cells: Mapping[str, str]) -> None:
    """Prints the table of these cells alone."""
    from ipe_bench.statistics.collect import collect
    from ipe_bench.statistics.summary import rows_of_all

    own = collect([output], cells.keys())
    _print_table(rows_of_all(own), own)


def _begin(directories: Sequence[Path]) -> Begun:
    """The analysis with the statistics of plugins, and what is wrong with those among its problems."""
    from ipe_bench.plugins.extensions import use_statistics
    from ipe_bench.statistics.analysis import begin

    faults = use_statistics()
    begun = begin(directories)
    begun.collection.further += faults
    return begun


def _write(begun: Begun, output: Path, made: str, figures: Which, formats: tuple[str, ...]) -> Collection:
    """Writes the report unless it is there already; returns what it is on, with all problems."""
    from ipe_bench.report.stamp import is_current, leave

    collection = begun.collection
    if not is_current(output, made, [*collection.problems, *collection.stale]):
        from ipe_bench.report import write_analysis

        result = write_analysis(begun, output, figures, formats)
        leave(output, made, [*collection.problems, *collection.stale], result.files)
    return collection


def _print_table(rows: Sequence[Mapping[str, Any]], collection: Collection) -> None:
    from ipe_bench.report.terminal import render

    totals = []
    if any(row["noise"] == "certified" for row in rows):
        from ipe_bench.report.certified_tables import certified_tables

        totals = [table for table in certified_tables(collection) if table.whole]
    out = console()
    out.print(render(rows, totals, out.width))


def _print_places(output: Path) -> None:
    figures = f"\nFigures  {output / 'figures'}" if any(output.glob("figures/*.png")) else ""
    places = f"\nSummary  {output / 'summary.csv'}\nTables   {output / 'tables'}{figures}"
    console().print(f"{places}\nReport   {output / 'report.html'}", markup=False, soft_wrap=True)


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
