"""`ipe-bench report DIR...`: tables, figures and report from what is stored."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console
from ipe_bench.runs.results import require_results
from ipe_bench.runs.store import TRUTH

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report import ReportResult


def main(arguments: Sequence[str]) -> int:
    """Aggregates the directories; the report goes to the first, or to output=DIR."""
    outputs = [a.removeprefix("output=") for a in arguments if a.startswith("output=")]
    directories = [Path(a) for a in arguments if not a.startswith("output=")]
    if not directories:
        raise UserError("report: name at least one directory of results, such as outputs/paper")
    if len(outputs) > 1:
        raise UserError(f"report: {' '.join(f'output={o}' for o in outputs)}: give one folder to write to")
    if len(directories) > 1 and not outputs:
        raise UserError("report: several directories need output=DIR, as the report on all is not that of the first")
    require_results(directories)
    output = Path(outputs[0]) if outputs else directories[0]
    result = _write(directories, output)
    for problem in (*result.problems, *result.stale):
        print(f"ipe-bench: {problem}", file=sys.stderr)
    _show(result.summary, result.certified, output, result)
    return 1 if result.problems else 0


def show_command(output: Path, cells: Mapping[str, str]) -> int:
    """Writes the report on all that the folder holds, and prints what belongs to these cells; the exit code.

    `cells` has a line for people by key.
    """
    from ipe_bench.report.certified_tables import certified_tables
    from ipe_bench.statistics.collect import collect
    from ipe_bench.statistics.summary import summary_of

    result = _write([output], output)
    own = collect([output], cells.keys())
    others = sum(cell.key not in cells and cell.label != TRUTH for cell in collect([output]).current)
    # What is wrong with a file or a folder may concern anybody; what other commands lack does not.
    of_cells = [p for p in result.problems if p.startswith(("missing: ", "failed: "))]
    elsewhere = [p for p in of_cells if not any(line in p for line in cells.values())]
    for problem in [p for p in result.problems if p not in elsewhere]:
        print(f"ipe-bench: {problem}", file=sys.stderr)
    if elsewhere:
        told = f"{_counted(len(elsewhere), 'problem')} of other commands; `ipe-bench status {output}` lists them"
        print(f"ipe-bench: {output}: {told}", file=sys.stderr)
    _show(summary_of(own), certified_tables(own)[1], output, result)
    if others:
        print(f"Here too  {_counted(others, 'result')} of other commands; `ipe-bench report {output}` shows all")
    return 1 if result.problems else 0


def _write(directories: Sequence[Path], output: Path) -> ReportResult:
    from ipe_bench.report import write_report

    return write_report(directories, output)


def _show(summary: pd.DataFrame, certified: pd.DataFrame, output: Path, result: ReportResult) -> None:
    from ipe_bench.report.terminal import render

    out = console()
    out.print(render(summary, certified, out.width))
    figures = f"\nFigures  {output / 'figures'}" if result.figures else ""
    out.print(f"\nSummary  {result.summary_path}\nTables   {output / 'tables'}{figures}", markup=False, soft_wrap=True)
    out.print(f"Report   {result.report}", markup=False, soft_wrap=True)


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
