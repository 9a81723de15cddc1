"""The report: tables, figures and one page, rebuilt from what is stored."""

from __future__ import annotations

import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ipe_bench.report.choice import PAGE, Which, file_formats, which_figures

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.statistics.analysis import Begun

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
    """One line per piece that is missing, failed, foreign or damaged; the exit code is 1 if there is any."""
    stale: tuple[str, ...]
    """One line per piece that older code computed, which is left out."""
    certified: pd.DataFrame
    """Mean correct digits per estimator and start on certified readings; empty without such runs."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Everything that was written."""
        return (self.summary_path, *self.tables, *self.figures, self.report)


def write_report(
    directories: Path | str | Sequence[Path | str],
    output: Path | str | None = None,
    *,
    figures: Which = "main",
    formats: str | Sequence[str] = PAGE,
) -> ReportResult:
    """Writes summary.csv, tables/, figures/ and report.html from what is stored, under `output` or the first directory.

    Raises:
        UserError: a directory does not exist, or there is no such choice of `figures` (all, main or none) or of
            `formats` (png, pdf and svg).
    """
    return begin_report(directories, output, figures=figures, formats=formats).written()


@dataclass(frozen=True)
class Pending:
    """A report whose summary is known, and whose files are still to be written."""

    begun: Begun
    output: Path
    figures: Which
    formats: tuple[str, ...]
    made: str
    """A digest of what it is made from."""

    def written(self) -> ReportResult:
        """Writes all files."""
        from ipe_bench.report.stamp import leave

        result = write_analysis(self.begun, self.output, self.figures, self.formats)
        leave(self.output, self.made, self._lines, result.files)
        return result

    def write_unless_current(self) -> None:
        """Writes all files, unless they are there already."""
        from ipe_bench.report.stamp import is_current

        if not is_current(self.output, self.made, self._lines):
            self.written()

    @property
    def _lines(self) -> list[str]:
        return [*self.begun.collection.problems, *self.begun.collection.stale]


def begin_report(
    directories: Path | str | Sequence[Path | str],
    output: Path | str | None = None,
    *,
    figures: Which = "main",
    formats: str | Sequence[str] = PAGE,
) -> Pending:
    """Collects and summarises, with the statistics of plugins. Raises UserError as `write_report` does."""
    from ipe_bench.plugins.extensions import use_statistics
    from ipe_bench.report.stamp import made_from
    from ipe_bench.statistics.analysis import begin

    kinds, which = file_formats(formats), which_figures(figures)
    folders = [Path(one) for one in ([directories] if isinstance(directories, Path | str) else directories)]
    place = folders[0] if output is None else Path(output)
    made, faults = made_from(folders, place, which, kinds), use_statistics()
    begun = begin(folders)
    begun.collection.further += faults
    return Pending(begun, place, which, kinds, made)


def write_analysis(begun: Begun, output: Path, which: Which = "main", formats: Sequence[str] = (PAGE,)) -> ReportResult:
    """Finishes an analysis and writes the report on it under `output`, with these figures in these formats."""
    from ipe_bench.basics.files import write_text
    from ipe_bench.report import extensions
    from ipe_bench.report.certified_tables import without_certified
    from ipe_bench.report.charts import charts
    from ipe_bench.report.figures import draw_all
    from ipe_bench.report.figures.views import views
    from ipe_bench.report.html import render_page
    from ipe_bench.report.table import write_table
    from ipe_bench.statistics.digits import certified_averages, certified_table

    analysis = begun.finish()
    summary_path = output / "summary.csv"
    write_text(summary_path, analysis.summary.to_csv(index=False))
    simulated = without_certified(analysis)
    problems = analysis.collection.further
    tables = extensions.report_tables(analysis)
    sections = extensions.sections(analysis, [table.name for table in tables], problems)
    further = [table for section in sections for table in section.tables]
    table_paths = [path for table in (*tables, *further) for path in write_table(table, output / "tables")]
    if len(analysis.profiles):
        table_paths.append(output / "tables" / "profiles.csv")
        write_text(table_paths[-1], analysis.profiles.to_csv(index=False))
    drawn = draw_all(simulated, output / "figures", which=which, formats=formats, problems=problems)
    page = render_page(analysis, tables, drawn, sections, list(charts(views(simulated)[0])))
    report = output / "report.html"
    write_text(report, page)
    return ReportResult(
        analysis.summary,
        summary_path,
        tuple(table_paths),
        tuple(path for figure in drawn for path in figure.files),
        report,
        analysis.problems,
        analysis.stale,
        certified_averages(certified_table(analysis.collection)),
    )


class _Callable(types.ModuleType):
    """`ipe_bench.report` is this room once it is imported, and a public function before: so the room can be called."""

    def __call__(
        self,
        directories: Path | str | Sequence[Path | str],
        output: Path | str | None = None,
        *,
        figures: Which = "main",
        formats: str | Sequence[str] = PAGE,
    ) -> ReportResult:
        return write_report(directories, output, figures=figures, formats=formats)


sys.modules[__name__].__class__ = _Callable
