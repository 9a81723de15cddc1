"""The report: tables, figures and one page, rebuilt from what is stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ReportResult", "write_report"]


@dataclass(frozen=True)
class ReportResult:
    """What `write_report` made."""

    summary: pd.DataFrame
    summary_path: Path
    tables: tuple[Path, ...]
    figures: tuple[Path, ...]
    report: Path
    problems: tuple[str, ...]
    """One line per piece that is missing, failed, foreign or damaged; the exit code is 1 where there is any."""
    stale: tuple[str, ...]
    """One line per piece that older code computed, which is left out."""
    certified: pd.DataFrame
    """Mean correct digits per estimator and start, on certified readings; empty where there are none."""


def write_report(directories: Sequence[Path | str], output: Path | str) -> ReportResult:
    """Writes summary.csv, tables/, figures/ and report.html under `output` from what is stored in the directories.

    Raises:
        UserError: a directory does not exist.
    """
    from ipe_bench.basics.files import write_atomically
    from ipe_bench.report.certified_tables import without_certified, write_certified
    from ipe_bench.report.figures import draw_all
    from ipe_bench.report.html import render_page
    from ipe_bench.report.tables import all_tables, write_tables
    from ipe_bench.statistics.analysis import analyse

    analysis = analyse(directories)
    output = Path(output)
    folder = output / "figures"
    summary_path = output / "summary.csv"
    write_atomically(summary_path, lambda temporary: analysis.summary.to_csv(temporary, index=False))
    tables = all_tables(analysis)
    table_paths = write_tables(analysis, tables, output / "tables")
    certified_paths, certified = write_certified(analysis.collection, output / "tables")
    table_paths += certified_paths
    figures: list[Path] = []
    shown = []
    pictured = without_certified(analysis)
    for drawn in draw_all(pictured, folder):
        figures += drawn.files
        shown.append((drawn.name, drawn.title, drawn.caption, drawn.files[0].read_bytes()))
    page = render_page(analysis, tables, shown)
    report = output / "report.html"
    write_atomically(report, lambda temporary: temporary.write_text(page, encoding="utf-8"))
    return ReportResult(
        analysis.summary,
        summary_path,
        table_paths,
        tuple(figures),
        report,
        analysis.problems,
        analysis.stale,
        certified,
    )
