"""Tables and figures as a paper wants them: chosen columns, in the width of one column of print or of two.

A table is a complete LaTeX environment of booktabs and siunitx; a figure is drawn anew at its final size, so that
nothing is scaled. What they say is what the report says.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.files import write_text
from ipe_bench.report.extensions import report_tables
from ipe_bench.report.table import COLUMN, COLUMN_GAP, PAGE, Table, latex, letters
from ipe_bench.statistics.analysis import Analysis

_NARROWEST, _WIDEST = 2.0, 20.0
POINTS_A_LETTER = 4.0
"""Mean width of a letter of 8 points."""


@dataclass(frozen=True)
class Export:
    """What was written, and a line for every table that is too wide."""

    files: tuple[Path, ...]
    too_wide: tuple[str, ...]


def export(
    analysis: Analysis, folder: Path, names: Sequence[str], columns: Sequence[str] = (), width: float = COLUMN
) -> Export:
    """Writes the tables and figures of these names into the folder: NAME.tex, or NAME.pdf and NAME.png, and the
    figures' captions.

    Raises:
        UserError: there is no such table, figure or column, or the width is none of paper.
    """
    if not _NARROWEST <= width <= _WIDEST:
        raise UserError(f"width={width:g}: give inches, such as {COLUMN:g} for one column and {PAGE:g} for two")
    tables = {table.name: table for table in report_tables(analysis)}
    chosen = [chosen_columns(tables[name], columns) for name in names if name in tables]
    if columns and not chosen:
        raise UserError(f"columns={','.join(columns)}: goes with a table; paper={','.join(names)} names none")
    files, captions = _figures(analysis, folder, [name for name in names if name not in tables], width, tables)
    for table in chosen:
        path = folder / f"{table.name}.tex"
        write_text(path, latex(table, width))
        files.append(path)
    if captions:
        write_text(folder / "captions.md", "\n\n".join(captions) + "\n")
        files.append(folder / "captions.md")
    return Export(tuple(files), tuple(line for table in chosen for line in _excess(table, width)))


# Tables --------------------------------------------------------------------------------------------------------------


def column_names(table: Table) -> list[str]:
    """The names by which columns are chosen: their titles in letters, digits and underscores."""
    names: list[str] = []
    for column in table.columns:
        name = re.sub(r"[^a-z0-9]+", "_", column.title.lower()).strip("_") or "column"
        names.append(name if name not in names else f"{name}_{names.count(name) + 1}")
    return names


def chosen_columns(table: Table, names: Sequence[str]) -> Table:
    """The table with these columns, in this order; all columns if none is named.

    Raises:
        UserError: it has no such column.
    """
    if not names:
        return table
    known = dict(zip(column_names(table), table.columns, strict=True))
    for name in names:
        if name not in known:
            raise UserError(f"columns={name}: {unknown(name, known, f'column of {table.name}')}")
    return replace(table, columns=[known[name] for name in names])


def inches(table: Table) -> float:
    """About how wide a table is."""
    points = sum(POINTS_A_LETTER * letters(column) for column in table.columns)
    return (points + 2 * COLUMN_GAP * (len(table.columns) - 1)) / 72


def _excess(table: Table, width: float) -> Iterator[str]:
    if inches(table) > width:
        yield (
            f"{table.name}: is about {inches(table):.1f} in wide, and {width:g} in were asked for; choose"
            f" with columns= among {', '.join(column_names(table))}"
        )


# Figures -------------------------------------------------------------------------------------------------------------


def _figures(
    analysis: Analysis, folder: Path, names: Sequence[str], width: float, tables: dict[str, Table]
) -> tuple[list[Path], list[str]]:
    """Their files and captions."""
    from ipe_bench.report.certified_tables import without_certified
    from ipe_bench.report.figures.common import column_width
    from ipe_bench.report.figures.gallery import drawings
    from ipe_bench.report.style import print_style

    files: list[Path] = []
    captions: list[str] = []
    seen: list[str] = []
    with print_style(), column_width(width):
        for drawing in drawings(without_certified(analysis), analysis.collection.further) if names else ():
            seen.append(drawing.name)
            if drawing.name in names:
                files += drawing.save(folder)
                captions.append(f"**{drawing.name}.** {drawing.title}. {drawing.caption}")
            if set(names) <= set(seen):
                break
    for name in names:
        if name not in seen:
            raise UserError(f"paper={name}: {unknown(name, [*tables, *seen], 'table or figure')}")
    return files, captions
