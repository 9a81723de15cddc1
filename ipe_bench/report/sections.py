"""Sections of the page that plugins write: paragraphs of text, and tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from ipe_bench.report.table import Part, Table
from ipe_bench.statistics.analysis import Analysis


@dataclass(frozen=True)
class Section:
    """A section of report.html, behind our tables; its tables are written to files as ours are."""

    title: str
    write: Callable[[Analysis], Iterator[Part]]
    """Yields paragraphs of plain text and tables; nothing if the section would be empty."""


@dataclass(frozen=True)
class Written:
    """What a section came to."""

    name: str
    title: str
    parts: Sequence[Part]

    @property
    def tables(self) -> list[Table]:
        return [part for part in self.parts if isinstance(part, Table)]
