"""Figures, tables and sections of plugins.

A report is complete without them: one that raises, or gives something that cannot be shown, is left out with a line
that says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from ipe_bench.basics.errors import StorageError, UserError, place_of
from ipe_bench.plugins.discovery import Option, blame
from ipe_bench.plugins.extensions import records
from ipe_bench.report.certified_tables import certified_tables, without_certified
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import FRAMES, View
from ipe_bench.report.sections import Section, Written
from ipe_bench.report.table import Table, comma_separated, latex, markdown
from ipe_bench.report.tables import all_tables
from ipe_bench.statistics.analysis import Analysis

T = TypeVar("T")


def guarded(make: Callable[[], T]) -> T:
    """Runs the code of a plugin; if it raises, raises UserError in a line that says where."""
    try:
        return make()
    except (UserError, StorageError):
        raise
    except (Exception, SystemExit) as error:
        raise UserError(blame(error) or place_of(error)) from error


def _require(thing: Any, kind: type, says: str = "gives") -> None:
    if not isinstance(thing, kind):
        raise UserError(f"{says} a {type(thing).__name__} and not a {kind.__name__}")


def figures(problems: list[str]) -> list[tuple[Option, Figure]]:
    """The figures of plugins; a line is added to the problems for every one that is none."""
    found = []
    for option, record in records("figure", problems):
        try:
            found.append((option, checked_figure(record)))
        except UserError as error:
            problems.append(f"figure={option.name}: {error}; it is left out")
    return found


def checked_figure(record: Any) -> Figure:
    """The record, or UserError if it is no figure of frames that exist."""
    _require(record, Figure, "is")
    if isinstance(record.frames, str) or not set(record.frames) <= set(FRAMES):
        raise UserError(f"frames={record.frames}: name some of {', '.join(FRAMES)}, in a tuple")
    return record


def drawings(figure: Figure, view: View) -> list[Drawing]:
    """The drawings that a plugin's figure makes of a view, or UserError if it raises or gives something else."""
    drawn = guarded(lambda: list(figure.draw(view)))
    for drawing in drawn:
        _require(drawing, Drawing)
    return drawn


def report_tables(analysis: Analysis) -> list[Table]:
    """Every table of the report: those on certified readings, ours on simulated trials, and those of plugins."""
    shown = certified_tables(analysis.collection) + all_tables(without_certified(analysis), analysis)
    added = written("table", analysis, [table.name for table in shown])
    return [*shown, *(table for one in added for table in one.tables)]


def written(group: str, analysis: Analysis, taken: Iterable[str]) -> list[Written]:
    """What the tables or the sections of plugins come to, none of them under the name of a table that is taken."""
    names, found, problems = set(taken), [], analysis.collection.further
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
    """What a plugin's section, or its function that makes a table or None, comes to, or UserError if it raises or gives
    something else than texts and tables under names of their own."""
    if option.group == "section":
        _require(record, Section, "is")
        found = Written(option.name, str(record.title), guarded(lambda: list(record.write(analysis))))
    else:
        table = guarded(lambda: record(analysis))
        found = Written(option.name, "", [] if table is None else [table])
    names = {*taken, "profiles"}
    for part in found.parts:
        if not isinstance(part, str):
            _require(part, Table)
            if part.name in names:
                raise UserError(f"there is a table {part.name} already; choose another name")
            names.add(part.name)
            guarded(lambda part=part: (markdown(part), latex(part), comma_separated(part)))
    return found
