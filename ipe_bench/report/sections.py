"""Tables and sections that plugins write: paragraphs of text, and tables, which are written to files as ours are.

A report is complete without them: one that raises, or gives something that cannot be shown, is left out with a line
that says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.plugins.discovery import Option
from ipe_bench.plugins.extensions import guarded, records, require_type
from ipe_bench.report.table import Part, Table, comma_separated, latex, markdown
from ipe_bench.report.tables import all_tables, certified_tables, without_certified
from ipe_bench.statistics.analysis import Analysis


@dataclass(frozen=True)
class Section:
    """A section of report.html, behind our tables."""

    title: str
    write: Callable[[Analysis], Iterator[Part]]
    """Yields paragraphs of plain text and tables; nothing if the section would be empty."""


@dataclass(frozen=True)
class Written:
    """What a section, or a table of a plugin, came to."""

    name: str
    title: str
    parts: Sequence[Part]

    @property
    def tables(self) -> list[Table]:
        return [part for part in self.parts if isinstance(part, Table)]


def report_tables(analysis: Analysis) -> list[Table]:
    """Every table of the report: those on certified readings, ours on simulated trials, and those of plugins."""
    shown = certified_tables(analysis.collection) + all_tables(without_certified(analysis), analysis)
    added = written("table", analysis, [table.name for table in shown])
    return [*shown, *(table for one in added for table in one.tables)]


def written(group: str, analysis: Analysis, taken: Iterable[str]) -> list[Written]:
    """What the tables or the sections of plugins come to, none of them under the name of a table that is taken."""
    names, found, problems = set(taken), [], analysis.collection.extra_problems
    for option, record in records(group, problems) if len(analysis.summary) else ():
        try:
            one = made(option, record, analysis, names)
        except UserError as error:
            problems.append(f"{group}={option.name}: {error}; it is left out")
            continue
        names.update(table.name for table in one.tables)
        found += [one] if one.parts else []
    return found


def made(option: Option, record: Any, analysis: Analysis, taken: Iterable[str]) -> Written:
    """What a plugin's section, or its function that makes a table or None, comes to.

    Raises:
        UserError: it raises, or gives something else than texts and tables under names of their own.
    """
    names = {*taken, "profiles"}
    with guarded():
        if option.group == "section":
            require_type(record, Section, "is")
            found = Written(option.name, str(record.title), list(record.write(analysis)))
        else:
            table = record(analysis)
            found = Written(option.name, "", [] if table is None else [table])
        for part in (part for part in found.parts if not isinstance(part, str)):
            require_type(part, Table)
            if part.name in names:
                raise UserError(f"there is a table {part.name} already; choose another name")
            names.add(part.name)
            for write in (markdown, latex, comma_separated):
                write(part)
    return found
