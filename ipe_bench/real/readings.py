"""Files of readings: one row per reading, with columns that say which reading it is, and the reading with its unit.

The header for GINS is `case,time [min],axis,reading [m/s]`. Rows may stand in any order; an empty reading is missing.
Cells are separated by commas or tabs; or by semicolons, and then a comma is a decimal point, as European spreadsheets
write it.
Nothing is guessed: what is not plainly a number, or not part of the table, is refused with its row.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_atomically
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Measurement

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_WITH_COMMA = re.compile(r"[+-]?\d*,\d*([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Table:
    """A file as text: its header, and its rows with their numbers in the file. Every row has as many cells as the
    header, and no two columns have one name."""

    path: Path
    heading: list[str]
    rows: list[tuple[int, list[str]]]
    decimal: str = "."
    key: str = "readings"
    """The key of the config that names the file."""
    digest: str = ""
    """SHA-256 of the bytes that were read."""

    def error(self, text: str) -> UserError:
        return UserError(f"{self.key}={self.path}: {text}")

    def number(self, text: str) -> float | None:
        """What a cell says in digits that everybody reads alike; None where it says something else."""
        plain = text.strip()
        if self.decimal == ",":
            # A point would be one between thousands, or one of another country: nobody can tell.
            plain = plain.replace(".", "?").replace(",", ".")
        return float(plain) if _NUMBER.fullmatch(plain) else None

    def value(self, text: str, where: str) -> float:
        """The finite number in a cell, NaN where it is empty; `where` names the row and the column.

        Raises:
            UserError: the cell says something else.
        """
        if not text.strip():
            return math.nan
        value = self.number(text)
        if value is not None and math.isfinite(value):
            return value
        if text.strip().lstrip("+-").lower() in ("nan", "inf", "infinity") or value is not None:
            raise self.error(f"{where}: {text.strip()} is not a reading; leave the cell empty if it is missing")
        said = f"'{' '.join(text.split())}' is not a number" + (", with decimal commas" if self.decimal == "," else "")
        raise self.error(f"{where}: {said}; correct it, or leave the cell empty if it is missing")

    def column(self, name: str) -> list[tuple[str, str]]:
        """The texts of a column, each with the words that name its place."""
        at = self.heading.index(name)
        return [(row[at], f"row {number}, column {name}") for number, row in self.rows]

    def require_known(self, known: Collection[str], wanted: Sequence[str]) -> None:
        """Refuses columns that are not known, as what they say would be left out without a word."""
        for name in self.heading:
            if name not in known:
                what = f"column {name}" if name else f"column {self.heading.index(name) + 1}, which has no name,"
                remedy = f"remove it, or set ignore_columns=[{name.split(' [')[0]}]" if name else "remove it"
                raise self.error(f"{what} is not understood; {remedy} (the header must be {','.join(wanted)})")


def header(model: Measurement) -> list[str]:
    """The columns of a readings file of this model."""
    return [
        *dict.fromkeys((*model.index, *model.input_columns)),
        f"reading [{model.reading_unit}]" if model.reading_unit else "reading",
    ]


def write_readings(path: Path, model: Measurement, z: Array) -> None:
    """Writes the readings z (m,); a NaN becomes an empty cell.

    Raises:
        UserError: the file is there already.
    """
    labels = zip(*{**model.index, **model.input_columns}.values(), strict=True)
    rows = [[*label, "" if math.isnan(value) else repr(float(value))] for label, value in zip(labels, z, strict=True)]
    _write(path, header(model), rows)


def write_truth(path: Path, model: Measurement, x: Array) -> None:
    """Writes parameters x (n,), given in multiples of their sizes, in physical units."""
    values = model.physical(x[None])[0]
    rows = [[p.name, p.unit, repr(float(v))] for p, v in zip(model.physical_parameters, values, strict=True)]
    _write(path, ["parameter", "unit", "value"], rows)


def _write(path: Path, heading: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    if path.exists():
        raise UserError(f"{path}: is there already and is not overwritten; name another file or remove it")

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([heading, *rows])

    write_atomically(path, write)


def require_enough(error: Callable[[str], UserError], z: Array, model: Measurement) -> None:
    """Refuses fewer readings z (m,) than the model has parameters, by what `error` makes of it."""
    if np.isfinite(z).sum() < model.n:
        raise error(f"{int(np.isfinite(z).sum())} readings are too few for {model.n} parameters")


def readings_of(table: Table, model: Measurement, rows: Sequence[int]) -> Array:
    """The readings z (m,) that stand in `rows` of a table."""
    column = table.column(header(model)[-1])
    return np.array([table.value(*column[row]) for row in rows], dtype=float)


def rows_of(table: Table, model: Measurement, also: Sequence[str] = ()) -> list[int]:
    """Where in the table each of the model's readings stands; `also` names further columns that are understood."""
    wanted = header(model)
    _require_columns(table, [*model.index, wanted[-1]])
    table.require_known((*wanted, *also), wanted)
    labels = list(zip(*model.index.values(), strict=True))
    places = {tuple(_label(v) for v in label): i for i, label in enumerate(labels)}
    columns = [table.heading.index(name) for name in model.index]
    found: dict[int, int] = {}
    for k, (number, row) in enumerate(table.rows):
        place = places.get(tuple(_label_of(table, row[at]) for at in columns))
        if place is None:
            said = _said(table, columns, row)
            raise table.error(f"row {number}: {model.name} has no reading {said}; correct or remove the row")
        if place in found:
            said, earlier = _said(table, columns, row), table.rows[found[place]][0]
            raise table.error(f"row {number}: {said} stands in row {earlier} already; keep one of them")
        found[place] = k
    if len(found) < model.m:
        absent = next(label for i, label in enumerate(labels) if i not in found)
        said = ", ".join(f"{name}={value}" for name, value in zip(model.index, absent, strict=True))
        raise table.error(
            f"has {len(found)} of {model.m} rows; the first absent one is {said} "
            "(a missing reading keeps its row, with an empty cell)"
        )
    return [found[i] for i in range(model.m)]


def _said(table: Table, columns: Sequence[int], row: Sequence[str]) -> str:
    return ", ".join(f"{table.heading[at]}={row[at].strip()}" for at in columns)


def read_table(path: Path, *, key: str = "readings", without: Collection[int] = ()) -> Table:
    """The header and the rows of a CSV or Parquet file, which `key` names in the config. Rows `without` need not be
    such rows: those with too few or too many cells are left out.

    Raises:
        UserError: the file is absent, or not such a table.
    """
    if not path.is_file():
        raise UserError(f"{key}={path}: there is no such file")
    data = path.read_bytes()
    table = (_read_parquet if path.suffix == ".parquet" else _read_text)(path, key, data)
    table = replace(table, digest=hashlib.sha256(data).hexdigest())
    for name in table.heading:
        if table.heading.count(name) > 1:
            what = f"column {name} stands there" if name else "columns without a name stand there"
            raise table.error(f"{what} twice; keep one")
    for number, row in table.rows:
        if len(row) != len(table.heading) and number not in without:
            raise table.error(_miscounted(table, number, row))
    return table


def _read_parquet(path: Path, key: str, data: bytes) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        raise UserError(f"{key}={path}: is not a readable Parquet file") from error
    names = [name for name in table.column_names if not name.startswith("__index_level_")]  # pandas' own row numbers
    table = table.select(names)
    columns = [["" if v is None else str(v) for v in column.to_pylist()] for column in table.columns]
    return Table(path, table.column_names, list(enumerate(map(list, zip(*columns, strict=True)), 1)), key=key)


def _read_text(path: Path, key: str, data: bytes) -> Table:
    text = _text_of(path, key, data)
    first = next((line for line in text.splitlines() if line.strip()), "")
    separator = next((sign for sign in ";\t" if sign in first), ",")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    try:
        lines = [(reader.line_num, row) for row in reader if any(c.strip() for c in row)]
    except csv.Error as error:
        raise UserError(
            f"{key}={path}: row {reader.line_num}: is not a readable CSV file ({error}); mend the quotes"
        ) from error
    if not lines:
        raise UserError(f"{key}={path}: is empty")
    rows = lines[1:]
    comma = separator == ";" and any(_WITH_COMMA.fullmatch(cell.strip()) for _, row in rows for cell in row)
    return Table(path, [name.strip() for name in lines[0][1]], rows, "," if comma else ".", key)


def _text_of(path: Path, key: str, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise UserError(
            f"{key}={path}: row {row}: is not a readable CSV file ({error.reason}); save it as CSV in UTF-8"
        ) from error


def _require_columns(table: Table, wanted: Sequence[str]) -> None:
    for name in wanted:
        if name in table.heading:
            continue
        quantity = name.split(" [")[0]
        other = next((h for h in table.heading if h.split(" [")[0] == quantity), None)
        if other is not None:
            raise table.error(f"column {other}: the unit must be that of {name}; convert the values")
        raise table.error(f"column {name} is missing; the header must be {','.join(wanted)}")


def _miscounted(table: Table, number: int, row: Sequence[str]) -> str:
    """What is wrong with a row that has more or fewer cells than the header."""
    if number == table.rows[0][0] and all(cell.strip() and table.number(cell) is None for cell in row):
        return f"row {number}: looks like the header, which must be the first row; remove what stands above it"
    text = f"row {number}: has {len(row)} cells and the header {len(table.heading)}"
    if len(row) > len(table.heading) and table.decimal == ".":
        return f"{text}; with decimal commas, separate the cells by semicolons"
    return f"{text}; a missing reading is an empty cell"


def _label(value: Any) -> Any:
    """Labels are compared as numbers where they are numbers: 3 and 3.0 are one."""
    text = str(value).strip()
    return round(float(text), 9) if _NUMBER.fullmatch(text) else text


def same_label(table: Table, text: str, label: Any) -> bool:
    """Whether a cell says that label: 3 and 3.0 are one."""
    return _label_of(table, text) == _label(label)


def _label_of(table: Table, text: str) -> Any:
    value = table.number(text)
    return text.strip() if value is None else round(value, 9)
