"""Writes a report: collects what is stored, summarises it, and makes the files."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.files import regular, write_json, write_text
from ipe_bench.plugins.extensions import files_of_records, use_statistics
from ipe_bench.report.formats import FIGURES, PAGE, TABLES
from ipe_bench.report.style import Which, file_formats, which_figures
from ipe_bench.report.tables.table import Part, Shown, Strong, Table, csv_text
from ipe_bench.runs.store import Store

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.statistics.analysis import Analysis, Begun

STAMP = ".report.json"
"""The file that says what a report was made from."""


@dataclass(frozen=True, repr=False)
class ReportResult(Shown):
    """The files of a report, its summary, and what is missing from it."""

    summary: pd.DataFrame
    summary_path: Path
    tables: tuple[Path, ...]
    figures: tuple[Path, ...]
    report: Path
    problems: tuple[str, ...]
    """Lines about missing, failed, foreign or damaged pieces; the exit code is 1 if there is
    any."""
    stale: tuple[str, ...]
    """One line per piece that older code computed, which is left out."""
    headline: tuple[Part, ...]
    """Opening of the page: a few sentences on what the data say, and for a sweep a table."""

    def parts(self) -> tuple[Part, ...]:
        return (*self.headline, *self.problems, *self.stale)

    def __repr__(self) -> str:
        return f"Report  {self.report}\n{self}"

    def _repr_html_(self) -> str:
        from markupsafe import Markup

        link = Markup('<a href="{}" target="_blank">{}</a>').format(
            os.path.relpath(self.report), self.report
        )
        return f"<p>{link}</p>{super()._repr_html_()}"

    @property
    def files(self) -> tuple[Path, ...]:
        """Everything that was written."""
        return (self.summary_path, *self.tables, *self.figures, self.report)


@dataclass(frozen=True)
class Pending:
    """A report whose summary is known, and whose files are still to be written."""

    begun: Begun
    output: Path
    figures: Which
    formats: tuple[str, ...]
    made: str
    """A digest of what it is made from."""

    def write_unless_current(self) -> None:
        """Writes all files, unless they are there already."""
        if not _is_current(self.output, self.made):
            self.written()

    def written(self) -> ReportResult:
        """Writes all files."""
        from ipe_bench.report.figures import draw_all
        from ipe_bench.report.page.headline import headline
        from ipe_bench.report.page.html import render_page
        from ipe_bench.report.sections import report_tables, written
        from ipe_bench.report.tables.table import write_table

        output = self.output
        analysis = self.begun.finish()
        problems = analysis.collection.extra_problems
        known = len(problems)
        tables = report_tables(analysis)
        sections = written("section", analysis, tables)
        added = [table for section in sections for table in section.tables]
        opening = headline(analysis)
        found = next((str(part) for part in opening if isinstance(part, Strong)), "")
        shown = [part for part in opening if isinstance(part, Table)]
        matrices = [replace(table, title=table.title or found) for table in shown]
        files = _write_summaries(analysis.summary, output)
        for table in (*tables, *added, *matrices):
            files += write_table(table, output / "tables", self.formats)
        files += _write_curves(analysis.simulated, output / "tables")
        kinds = [kind for kind in FIGURES if kind in self.formats]
        drawn = draw_all(analysis, output / "figures", which=self.figures, formats=kinds)
        write_text(output / "report.html", render_page(analysis, tables, drawn, sections))
        result = ReportResult(
            summary=analysis.summary,
            summary_path=output / "summary.csv",
            tables=tuple(files),
            figures=tuple(path for figure in drawn for path in figure.files),
            report=output / "report.html",
            problems=tuple(analysis.collection.problems),
            stale=tuple(analysis.collection.stale),
            headline=tuple(opening),
        )
        for name in _earlier_tables(output) - {path.name for path in files}:
            (output / "tables" / name).unlink(missing_ok=True)
        # What plugins cannot make is said each time: such a report is made from nothing known.
        made = self.made if len(problems) == known else ""
        write_json(output / STAMP, {"from": made, "files": _digests(result.files)})
        return result


def _earlier_tables(output: Path) -> set[str]:
    """Names the files of tables that an earlier report wrote, or may have written where no stamp
    says which."""
    from ipe_bench.report.sections import CURVES
    from ipe_bench.report.tables.reports import NAMES

    known = _stamped(output)
    if "files" in known:
        files = map(Path, known["files"])
        return {path.name for path in files if path.parent.name == "tables"}
    return {f"{name}.{kind}" for name in (*NAMES, *CURVES) for kind in TABLES}


def _write_summaries(summary: pd.DataFrame, output: Path) -> list[Path]:
    """Writes the summary over all parameters, which is not returned, that of each, and both with
    every column."""
    from ipe_bench.statistics.registry import main_columns
    from ipe_bench.statistics.statistic import ALL

    main = main_columns(summary)
    is_total = main["parameter"] == ALL
    frames = {"summary": main[is_total], "summary_all": summary, "parameters": main[~is_total]}
    return _write_frames(frames, output)[1:]


def _write_curves(analysis: Analysis, folder: Path) -> list[Path]:
    """Writes the frames of the analysis that are too long for tables."""
    from ipe_bench.report.sections import CURVES

    frames = {name: getattr(analysis, name) for name in CURVES}
    return _write_frames({name: one for name, one in frames.items() if len(one)}, folder)


def _write_frames(frames: Mapping[str, pd.DataFrame], folder: Path) -> list[Path]:
    """Writes each frame as NAME.csv."""
    files = {folder / f"{name}.csv": frame for name, frame in frames.items()}
    for file, frame in files.items():
        write_text(file, csv_text(frame))
    return list(files)


def begin_report(
    folders: Sequence[Path],
    output: Path | str | None = None,
    *,
    figures: Any = "main",
    formats: Any = PAGE,
) -> Pending:
    """Collects and summarises what folders hold, with the statistics of plugins.

    Raises:
        UserError: there is no such choice of `figures` (all, main or none) or of `formats`.
    """
    from ipe_bench.statistics.analysis import Begun
    from ipe_bench.statistics.collect import collect

    kinds = file_formats(formats)
    which = which_figures(figures)
    place = folders[0] if output is None else Path(output)
    made = _made_from(folders, place, which, kinds)
    faults = use_statistics()
    begun = Begun(collect(folders))
    begun.collection.extra_problems += faults
    return Pending(begun, place, which, kinds, made)


def _made_from(directories: Sequence[Path], output: Path, *choices: object) -> str:
    """Computes a digest of the report's sources before they are read: results that come meanwhile
    change it."""
    sources = [
        p for p in Path(__file__).parents[2].rglob("*") if p.suffix in {".py", ".j2", ".css", ".js"}
    ]
    stores = [Store(directory) for directory in directories]
    stored = [
        p for s in stores for folder in (s.trials, s.runs, s.failed) for p in folder.glob("*")
    ]
    libraries = [
        version(name) for name in ("jinja2", "matplotlib", "numpy", "pandas", "scipy", "seaborn")
    ]
    names = [str(path.absolute()) for path in (output, *directories)]
    known = [names, choices, libraries, *map(_digests, (files_of_records(), sources, stored))]
    return hashlib.sha256(repr(known).encode()).hexdigest()


def _is_current(output: Path, made: str) -> bool:
    """Returns whether the report under `output` was made from this, and its files are as
    written."""
    known = _stamped(output)
    return known == {"from": made, "files": _digests(map(Path, known.get("files", ())))}


def _stamped(output: Path) -> dict[str, Any]:
    """Returns the stamp of the report under `output`; empty if there is none."""
    with contextlib.suppress(OSError, ValueError):
        known = json.loads(regular(output / STAMP).read_text(encoding="utf-8"))
        if isinstance(known, dict):
            return known
    return {}


def _digests(paths: Iterable[Path]) -> dict[str, str]:
    """Computes SHA-256 by absolute path, without unreadable files and those that another command is
    removing."""
    found = {}
    for path in sorted(paths):
        with contextlib.suppress(OSError):
            found[str(path.absolute())] = hashlib.sha256(regular(path).read_bytes()).hexdigest()
    return found
