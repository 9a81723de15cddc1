"""Figures, tables and sections of plugins.

A report is complete without them: one that raises, or gives something that cannot be shown, is left out with a line
that says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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


def _usable(group: str, problems: list[str], make: Callable[[Option, Any], T]) -> Iterator[tuple[Option, T]]:
    """What is made of each record of the group; a line is added to the problems for every one that cannot be used."""
    for option, record in records(group, problems):
        try:
            yield option, make(option, record)
        except UserError as error:
            problems.append(f"{group}={option.name}: {error}; it is left out")


def _require(thing: Any, kind: type, says: str = "gives") -> None:
    if not isinstance(thing, kind):
        raise UserError(f"{says} a {type(thing).__name__} and not a {kind.__name__}")


def figures(problems: list[str]) -> list[tuple[Option, Figure]]:
    """The figures of plugins; a line is added to the problems for every one that is none."""
    return list(_usable("figure", problems, lambda _, record: checked_figure(record)))


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
    if not analysis.summary.empty:

        def make(_: Option, record: Any) -> Table | None:
            return made_table(record, analysis, [table.name for table in shown])

        for _, table in _usable("table", analysis.collection.further, make):
            shown += [] if table is None else [table]
    return shown


def made_table(record: Any, analysis: Analysis, taken: Iterable[str] = ()) -> Table | None:
    """The table that a plugin's function makes of the analysis, None if there is nothing to show, or UserError if it
    raises or gives something else than a table under a name of its own."""
    table = guarded(lambda: record(analysis))
    if table is not None:
        _check_table(table, taken)
    return table


def _check_table(table: Any, taken: Iterable[str]) -> None:
    _require(table, Table)
    if table.name in (*taken, "profiles"):
        raise UserError(f"there is a table {table.name} already; choose another name")
    guarded(lambda: (markdown(table), latex(table), comma_separated(table)))


def sections(analysis: Analysis, taken: Iterable[str], problems: list[str]) -> list[Written]:
    """The sections of plugins that have something to say."""
    names, found = set(taken), []
    if not analysis.summary.empty:
        for _, written in _usable("section", problems, lambda o, record: made_section(o.name, record, analysis, names)):
            names.update(table.name for table in written.tables)
            found += [written] if written.parts else []
    return found


def made_section(name: str, record: Any, analysis: Analysis, taken: Iterable[str] = ()) -> Written:
    """The texts and tables that a plugin's section makes of the analysis, or UserError if it raises or gives something
    else."""
    _require(record, Section, "is")
    written = Written(name, str(record.title), guarded(lambda: list(record.write(analysis))))
    names = set(taken)
    for part in written.parts:
        if not isinstance(part, str):
            _check_table(part, names)
            names.add(part.name)
    return written
