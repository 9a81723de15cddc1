"""`ipe-bench report DIR...`: tables, figures and report from what is stored."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console
from ipe_bench.runs.results import require_results


def main(arguments: Sequence[str]) -> int:
    """Aggregates the directories; the report goes to the first, or to output=DIR."""
    outputs = [a.removeprefix("output=") for a in arguments if a.startswith("output=")]
    directories = [Path(a) for a in arguments if not a.startswith("output=")]
    if not directories:
        raise UserError("report: name at least one directory of results, such as outputs/paper")
    require_results(directories)
    return show(directories, Path(outputs[0]) if outputs else directories[0])


def show(directories: Sequence[Path], output: Path) -> int:
    """Writes the report, prints its table and where things are; returns the exit code."""
    from ipe_bench.report import write_report
    from ipe_bench.report.terminal import render

    result = write_report(directories, output)
    out = console()
    out.print(render(result.summary, result.certified))
    for problem in (*result.problems, *result.stale):
        print(f"ipe-bench: {problem}", file=sys.stderr)
    out.print(f"\nSummary  {result.summary_path}\nTables   {output / 'tables'}\nFigures  {output / 'figures'}")
    out.print(f"Report   {result.report}")
    return 1 if result.problems else 0
