"""Tables and sections that plugins write; one that raises, or gives something else, is left out
with a line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.plugins.extensions import added, require_type
from ipe_bench.report.tables.certified import certified_tables
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.report.tables.table import Part, Table
from ipe_bench.statistics.analysis import Analysis

CURVES = ("distributions",)
"""Frames of an analysis that are files beside the tables, and too long to be read on a page."""


@dataclass(frozen=True)
class Section:
    """Defines a section of report.html, which follows our tables.

    Required: `title` and `write`. Optional: none. Promised: `write` does not write into the
    analysis, whose frames our tables are made of, and its tables have new names; one that raises is
    left out with a line.

    >>> def settings(analysis):
    ...     yield f"There are {len(analysis.summary)} rows."
    >>> section = Section("Settings", settings)
    >>> section.title
    'Settings'
    """

    title: str
    write: Callable[[Analysis], Iterator[Part]]
    """Yields paragraphs of plain text and tables; none where the section would be empty."""


@dataclass(frozen=True)
class Written:
    """The parts that a section or a table of a plugin gives."""

    name: str
    title: str
    parts: Sequence[Part]

    @property
    def tables(self) -> list[Table]:
        return [part for part in self.parts if isinstance(part, Table)]


def report_tables(analysis: Analysis) -> list[Table]:
    """Returns all tables of the report: on certified readings, ours on simulated trials, and those
    of plugins."""
    shown = certified_tables(analysis.collection) + all_tables(analysis.simulated, analysis)
    added = written("table", analysis, shown)
    return [*shown, *(table for one in added for table in one.tables)]


def written(group: str, analysis: Analysis, tables: Iterable[Table]) -> list[Written]:
    """Returns the tables or sections of plugins, their tables under unique names."""
    names = {*CURVES, *(table.name for table in tables)}

    def make(record: Any) -> tuple[str, list[Part]]:
        if group == "section":
            require_type(record, Section, "is")
            title = str(record.title)
            parts = list(record.write(analysis))
        else:
            title = ""
            table = record(analysis)
            parts = [] if table is None else [table]
        for part in parts:
            if isinstance(part, str):
                continue
            require_type(part, Table)
            if part.name in names:
                raise UserError(f"there is a table {part.name} already; choose another name")
            names.add(part.name)
        return title, parts

    problems = analysis.collection.extra_problems
    found = added(group, problems, make) if len(analysis.summary) else ()
    return [Written(name, title, parts) for name, (title, parts) in found if parts]
