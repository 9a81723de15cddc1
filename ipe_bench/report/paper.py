"""Exports tables and figures for a paper: chosen columns, and figures in the width of one or two
columns of print."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from ipe_bench.basics.errors import UserError, refuse_unknown
from ipe_bench.basics.files import write_text
from ipe_bench.report.sections import report_tables
from ipe_bench.report.tables.table import COLUMN, PAGE, Column, Table, latex
from ipe_bench.statistics.analysis import Analysis

_KEYS = ("parameter", "second", "status", "start", "state", "message")
"""Titles of further columns that tell rows apart, besides those up to the name of a row."""


def export(
    analysis: Analysis,
    folder: Path,
    names: Sequence[str],
    columns: Sequence[str] = (),
    width: float = COLUMN,
) -> list[Path]:
    """Writes the tables and figures of these names into the folder, and returns the files:
    NAME.tex, or NAME.pdf and NAME.png, and the figures' captions.

    Raises:
        UserError: there is no such table, figure or column, or the width is none of paper.
    """
    if not 2 <= width <= 20:
        raise UserError(
            f"width={width:g}: give inches, such as {COLUMN:g} for one column and {PAGE:g} for two"
        )
    tables = {table.name: table for table in report_tables(analysis)}
    chosen = [with_columns(tables[name], columns) for name in names if name in tables]
    if columns and not chosen:
        raise UserError(
            f"columns={','.join(columns)}: goes with a table; paper={','.join(names)} names none"
        )
    others = [name for name in names if name not in tables]
    files = _figures(analysis, folder, others, width, tables)
    for table in chosen:
        files.append(folder / f"{table.name}.tex")
        write_text(files[-1], latex(table, width))
    return files


def with_columns(table: Table, names: Sequence[str]) -> Table:
    """Returns the table with these columns, in this order, or all, behind those that tell its rows
    apart; a column's name is its title in letters, digits and underscores."""
    known: dict[str, Column] = {}
    for column in table.columns:
        words = re.sub(r"[^a-z0-9]+", "_", column.title.lower())
        name = words.strip("_") or "column"
        alike = [other for other in known if re.fullmatch(rf"{name}(_\d+)?", other)]
        known[f"{name}_{len(alike) + 1}" if alike else name] = column
    for name in names:
        refuse_unknown(f"columns={name}", name, known, f"column of {table.name}")
    chosen = [known[name] for name in names or known]
    apart = list(table.columns[: table.naming + 1])
    apart += [one for one in table.columns[len(apart) :] if one.title in _KEYS]
    keys = [one for one in apart if not _is_told(one, chosen)]
    return replace(table, columns=[*keys, *chosen])


def _is_told(key: Column, chosen: Sequence[Column]) -> bool:
    """Returns whether a column is chosen already, or says the same in every row."""
    texts = {cell.text for cell in key.cells}
    return len(texts) == 1 or any(key is one for one in chosen)


def _figures(
    analysis: Analysis, folder: Path, names: Sequence[str], width: float, tables: Iterable[str]
) -> list[Path]:
    """Writes figures, and captions.md with their captions; returns the files."""
    from ipe_bench.report.figures import drawings
    from ipe_bench.report.style import print_style

    files: list[Path] = []
    captions: dict[str, str] = {}
    with print_style(width):
        for drawing in drawings(analysis) if names else ():
            captions[drawing.name] = f"**{drawing.name}.** {drawing.title}. {drawing.caption}"
            files += drawing.save(folder) if drawing.name in names else ()
            if set(names) <= captions.keys():
                break
    for name in names:
        refuse_unknown(f"paper={name}", name, [*tables, *captions], "table or figure")
    if names:
        files.append(folder / "captions.md")
        asked = [captions[name] for name in names]
        write_text(files[-1], "\n\n".join(asked) + "\n")
    return files
