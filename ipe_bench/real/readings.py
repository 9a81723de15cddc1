"""Reads files of readings, and completes the model by their columns.

A file has one row per reading, in any order, with columns that say which reading it is, and the reading with its unit:
`case,time [min],axis,reading [m/s]` for GINS. An empty reading is missing. Cells are separated by commas or tabs; or by
semicolons, and then a comma is a decimal point. What is not plainly a number is refused with its row.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, did_you_mean, unknown
from ipe_bench.basics.files import write_text
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Input, Measurement
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo, informed

SIGMA = "sigma"
"""The column of standard deviations of the readings."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MISSING = "a missing reading is an empty cell"
_SAMPLES = Path("ipe_bench/real/samples")
"""Folder of the package's own samples in a clone; from elsewhere, they are found in the package."""
_WITH_COMMA = re.compile(r"[+-]?\d*,\d*([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Readings:
    """Holds one file of readings, or several."""

    model: Measurement
    """The model with the inputs of the file."""
    z: Array
    """(m,); NaN where a reading is missing."""
    deviations: Array | None = None
    """(m,): standard deviations where the file has them; NaN where the reading is missing."""
    columns: tuple[str, ...] = ()
    """The columns that were read, as the file calls them."""
    files: tuple[tuple[str, str], ...] = ()
    """Each file with the SHA-256 of the bytes that were read."""


# Tables of text -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TextTable:
    """Holds a file as text: its header, and its rows with their numbers in the file."""

    path: Path
    heading: Sequence[str] = ()
    rows: Sequence[tuple[int, list[str]]] = ()
    decimal: str = "."
    digest: str = ""
    """SHA-256 of the bytes that were read."""

    def error(self, text: str) -> UserError:
        return UserError(f"readings={self.path}: {text}")

    def number(self, text: str) -> float | None:
        """Parses the number in a cell, or None; a point among decimal commas is ambiguous, and none."""
        return _number(text.replace(".", "?").replace(",", ".") if self.decimal == "," else text)

    def value(self, text: str, where: str) -> float:
        """Parses the finite number in a cell, NaN if it is empty; otherwise a UserError at `where`, its row and
        column."""
        if not text.strip():
            return math.nan
        value = self.number(text)
        if value is not None and math.isfinite(value):
            return value
        if text.strip().lstrip("+-").lower() in ("nan", "inf", "infinity") or value is not None:
            raise self.error(
                f"{where}: {text.strip()} is not a reading; leave the cell empty if it is missing"
            )
        said = f"'{' '.join(text.split())}' is not a number" + (
            ", with decimal commas" if self.decimal == "," else ""
        )
        raise self.error(f"{where}: {said}; correct it, or leave the cell empty if it is missing")

    def column(self, name: str) -> list[tuple[str, str]]:
        """Lists the texts of a column, each with the words that name its place."""
        at = self.heading.index(name)
        return [(row[at], f"row {number}, column {name}") for number, row in self.rows]

    def find(self, wanted: str) -> str | None:
        """Finds the column of that heading; a heading without a unit is found with one, too."""
        if wanted in self.heading:
            return wanted
        return next(
            (name for name in self.heading if " [" not in wanted and _quantity(name) == wanted),
            None,
        )

    def require_known(self, known: Collection[str], wanted: Sequence[str]) -> None:
        """Refuses columns that are not known."""
        for name in self.heading:
            if name not in known:
                meant = did_you_mean(name, [one for one in wanted if one not in self.heading])
                what = (
                    f"column {name}"
                    if name
                    else f"column {self.heading.index(name) + 1}, which has no name,"
                )
                remedy = (
                    f"remove it, or set ignore_columns=[{name.split(' [')[0]}]"
                    if name
                    else "remove it"
                )
                hint = f"{meant} Otherwise" if meant else ";"
                raise self.error(
                    f"{what} is not understood{hint} {remedy} (the header must be {','.join(wanted)})"
                )

    def refuse_other_unit(self, name: str) -> None:
        """Refuses a column that is there with another unit, or with none."""
        for other in self.heading:
            if _quantity(other) == _quantity(name):
                if not _unit(other):
                    raise self.error(
                        f"column {other}: has no unit; call it {name} if that is the unit of its values"
                    )
                raise self.error(
                    f"column {other}: the unit must be that of {name}; convert the values"
                )


def _number(text: str) -> float | None:
    text = text.strip()  # of separators too, which float() does not take
    return float(text) if _NUMBER.fullmatch(text) else None


def _quantity(heading: str) -> str:
    return heading.partition(" [")[0].strip()


def _unit(heading: str) -> str:
    return heading.partition("[")[2].rstrip("] ")


def read_tables(paths: Sequence[Path], without: Sequence[str] = ()) -> list[TextTable]:
    """Reads the tables of files, without the columns of these headings.

    Raises:
        UserError: a file is absent or not a table, or no file has such a column.
    """
    tables = [_read_table(path) for path in paths]
    for name in without:
        if not any(table.find(name.strip()) for table in tables):
            headings = dict.fromkeys(heading for table in tables for heading in table.heading)
            raise UserError(f"ignore_columns={name}: {unknown(name, list(headings), 'column')}")
    reduced = []
    for table in tables:
        gone = {table.find(name.strip()) for name in without}
        kept = [k for k, name in enumerate(table.heading) if name not in gone]
        rows = [(number, [row[k] for k in kept]) for number, row in table.rows]
        reduced.append(replace(table, heading=[table.heading[k] for k in kept], rows=rows))
    return reduced


def _read_table(path: Path) -> TextTable:
    """Reads the table of a CSV or Parquet file, in which every row has as many cells as the header."""
    if path.parent == _SAMPLES and not path.is_file():
        path = Path(__file__).with_name("samples") / path.name
    if not path.is_file():
        raise TextTable(path).error("there is no such file")
    data = path.read_bytes()
    table = TextTable(path, digest=hashlib.sha256(data).hexdigest())
    table = (_with_parquet if path.suffix == ".parquet" else _with_text)(table, data)
    if all(table.number(name) is not None for name in table.heading):
        raise table.error(
            "the first row has only numbers and is no header; write the names of the columns above it"
        )
    for name, count in Counter(table.heading).items():
        if count > 1:
            what = f"column {name} stands there" if name else "columns without a name stand there"
            raise table.error(f"{what} twice; keep one")
    for number, row in table.rows:
        if len(row) == len(table.heading):
            continue
        if number == table.rows[0][0] and all(
            cell.strip() and table.number(cell) is None for cell in row
        ):
            text = "looks like the header, which must be the first row; remove what stands above it"
        else:
            decimal = len(row) > len(table.heading) and table.decimal == "."
            remedy = (
                "with decimal commas, separate the cells by semicolons" if decimal else _MISSING
            )
            text = f"has {len(row)} cells and the header {len(table.heading)}; {remedy}"
        raise table.error(f"row {number}: {text}")
    return table


def _with_parquet(table: TextTable, data: bytes) -> TextTable:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        found = pq.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        raise table.error("is not a readable Parquet file") from error
    found = found.select(
        [n for n in found.column_names if not n.startswith("__index_level_")]
    )  # pandas' row numbers
    columns = [
        ["" if v is None else str(v) for v in column.to_pylist()] for column in found.columns
    ]
    return replace(
        table,
        heading=found.column_names,
        rows=list(enumerate(map(list, zip(*columns, strict=True)), 1)),
    )


def _with_text(table: TextTable, data: bytes) -> TextTable:
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise table.error(
            f"row {row}: is not a readable CSV file ({error.reason}); save it as CSV in UTF-8"
        ) from error
    first = next((line for line in text.splitlines() if line.strip()), "")
    separator = next((sign for sign in ";\t" if sign in first), ",")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    try:
        lines = [(reader.line_num, row) for row in reader if any(c.strip() for c in row)]
    except csv.Error as error:
        raise table.error(
            f"row {reader.line_num}: is not a readable CSV file ({error}); mend the quotes"
        ) from error
    if not lines:
        raise table.error("is empty")
    (_, heading), *rows = lines
    comma = separator == ";" and any(
        _WITH_COMMA.fullmatch(cell.strip()) for _, row in rows for cell in row
    )
    return replace(
        table, heading=[name.strip() for name in heading], rows=rows, decimal="," if comma else "."
    )


# Files of a model -----------------------------------------------------------------------------------------------------


def labels(model: Measurement) -> Mapping[str, Sequence[Any]]:
    """Returns the entries of every column but that of the readings."""
    return {**model.index, **model.input_columns}


def header(model: Measurement) -> list[str]:
    """Returns the columns of a readings file of this model."""
    return [*labels(model), f"reading [{model.reading_unit}]" if model.reading_unit else "reading"]


def write_readings(path: Path, model: Measurement, z: Array) -> None:
    """Writes the readings z (m,); a NaN becomes an empty cell.

    Raises:
        UserError: the file is there already.
    """
    rows = zip(
        *labels(model).values(),
        ["" if math.isnan(value) else repr(float(value)) for value in z],
        strict=True,
    )
    _write(path, [header(model), *rows])


def write_truth(path: Path, model: Measurement, x: Array) -> None:
    """Writes parameters x (n,), given in multiples of their sizes, in physical units."""
    values = model.physical(x[None])[0]
    rows = [
        [p.name, p.unit, repr(float(v))]
        for p, v in zip(model.physical_parameters, values, strict=True)
    ]
    _write(path, [["parameter", "unit", "value"], *rows])


def _write(path: Path, rows: Sequence[Sequence[Any]]) -> None:
    if path.exists():
        raise UserError(
            f"{path}: is there already and is not overwritten; name another file or remove it"
        )
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_text(path, text.getvalue())


def open_together(
    paths: Sequence[Path],
    model: Measurement,
    known: Sequence[ParameterInfo] = (),
    without: Sequence[str] = (),
) -> Readings:
    """Opens one file of readings or several, which share the parameters that are not a file's own.

    `known` is what is known of all their parameters. `without` are columns that are left out, by their headings with
    their units or without.

    Raises:
        UserError: a file is absent or does not hold readings of this model, files differ in what they know, or there
            are fewer readings than parameters.
    """
    if isinstance(model, ConstrainedModel):
        return open_together(paths, model.whole, (*model.known, *known), without)
    tables = read_tables(paths, without)
    found = _together(paths, [_readings_in(table, model) for table in tables])
    model, files = (
        informed(found.model, known),
        tuple((str(table.path), table.digest) for table in tables),
    )
    if (there := int(np.isfinite(found.z).sum())) < model.n:
        shown = str(paths[0]) if len(paths) == 1 else f"[{','.join(map(str, paths))}]"
        raise UserError(f"readings={shown}: {there} readings are too few for {model.n} parameters")
    return replace(found, model=model, files=files)


def _together(paths: Sequence[Path], found: Sequence[Readings]) -> Readings:
    first = found[0]
    if len(found) == 1:
        return first
    units = {_quantity(name): _unit(name) for name in first.columns}
    for one, path in zip(found, paths, strict=True):
        if (one.deviations is None) != (first.deviations is None):
            with_sigma, without = (paths[0], path) if one.deviations is None else (path, paths[0])
            raise UserError(
                f"readings={without}: has no column {SIGMA}, as {with_sigma} has; give it one, too"
            )
        for name in one.columns:  # one formula is made of all files
            other = units.get(_quantity(name))
            if other and _unit(name) and _unit(name) != other:
                raise UserError(
                    f"readings={path}: column {name}: {paths[0]} has it in {other}; convert the values"
                )
    deviations = [one.deviations for one in found if one.deviations is not None]
    joint = Joint(tuple(one.model for one in found))
    return Readings(
        joint,
        np.concatenate([one.z for one in found]),
        np.concatenate(deviations) if deviations else None,
    )


def _readings_in(table: TextTable, model: Measurement) -> Readings:
    """Reads a file, which may have too few readings."""
    sigma = table.find(SIGMA)
    columns = [table.find(wanted.heading) for wanted in model.inputs]
    there = [c for i, c in zip(model.inputs, columns, strict=True) if c is not None and not i.label]
    known = bool(model.inputs) and model.input_columns_known and not there
    # An input that tells readings apart, such as the time, is in every file.
    if not model.inputs or (
        known and not any(i.heading in model.index for i in model.inputs if not i.label)
    ):
        rows, shown = _rows_of(table, model, [sigma] if sigma else []), header(model)[-1]
        cells = table.column(shown)
        z = np.array([table.value(*cells[row]) for row in rows], dtype=float)
        return Readings(model, z, _sigmas(table, sigma, rows, z, shown))
    for wanted, column in zip(model.inputs, columns, strict=True):
        if column is None and wanted.default is None:
            table.refuse_other_unit(wanted.heading)
            absent = model.absent_input(wanted.heading, list(table.heading))
            raise table.error(f"column {wanted.heading} is missing; {absent}")
    if not table.rows:
        raise table.error("has a header and no rows")
    shown = _reading_column(table, model)
    used = (*(c for c in columns if c is not None), shown, *([sigma] if sigma else []))
    z = np.array([table.value(*cell) for cell in table.column(shown)])
    known = {
        wanted.heading: [wanted.default] * len(z)
        if column is None
        else [_input(table, wanted, *cell) for cell in table.column(column)]
        for wanted, column in zip(model.inputs, columns, strict=True)
    }
    try:
        sampled = model.with_inputs(known, len(z))
    except UserError as error:
        raise table.error(str(error)) from None
    headings = [wanted.heading for wanted in model.inputs]
    table.require_known(
        (*used, *sampled.index), tuple(dict.fromkeys((*headings, _shown_as(model)[0], SIGMA)))
    )
    for name, values in sampled.index.items():
        if name not in headings and name in table.heading:
            for (text, where), label in zip(table.column(name), values, strict=True):
                if _label(text, table.number) != _label(str(label)):
                    said = f"'{text}' stands where the order of the rows says {label}; leave the column out"
                    raise table.error(f"{where}: {said}")
    return Readings(sampled, z, _sigmas(table, sigma, range(len(z)), z, shown), used)


def _rows_of(table: TextTable, model: Measurement, also: Sequence[str]) -> list[int]:
    """Finds the row of each of the model's readings in the table; `also` names further columns that are understood."""
    wanted = header(model)
    for name in (*model.index, wanted[-1]):
        if name not in table.heading:
            table.refuse_other_unit(name)
            raise table.error(f"column {name} is missing; the header must be {','.join(wanted)}")
    table.require_known((*wanted, *also), wanted)
    every = list(zip(*model.index.values(), strict=True))
    places = {tuple(_label(str(value)) for value in label): i for i, label in enumerate(every)}
    columns = [table.heading.index(name) for name in model.index]
    found: dict[int, int] = {}
    for k, (number, row) in enumerate(table.rows):
        place = places.get(tuple(_label(row[at], table.number) for at in columns))
        if place is None or place in found:
            said = ", ".join(f"{table.heading[at]}={row[at].strip()}" for at in columns)
            if place is None:
                raise table.error(
                    f"row {number}: {model.name} has no reading {said}; correct or remove the row"
                )
            earlier = table.rows[found[place]][0]
            raise table.error(
                f"row {number}: {said} stands in row {earlier} already; keep one of them"
            )
        found[place] = k
    if len(found) < model.m:
        absent = next(label for i, label in enumerate(every) if i not in found)
        said = ", ".join(f"{name}={value}" for name, value in zip(model.index, absent, strict=True))
        raise table.error(
            f"has {len(found)} of {model.m} rows; the first absent one is {said} "
            "(a missing reading keeps its row, with an empty cell)"
        )
    return [found[i] for i in range(model.m)]


def _label(text: str, number: Callable[[str], float | None] = _number) -> Any:
    """Converts a label to a number if it is one: 3 and 3.0 are one."""
    value = number(text)
    return text.strip() if value is None else round(value, 9)


def _shown_as(model: Measurement) -> list[str]:
    """Returns the names that the column of the readings may have."""
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    return [f"{name}{unit}" for name in dict.fromkeys((model.reading_name, "reading"))]


def _reading_column(table: TextTable, model: Measurement) -> str:
    names = _shown_as(model)
    if found := next(filter(None, map(table.find, names)), None):
        return found
    for name in names:
        table.refuse_other_unit(name)
    known = {SIGMA, *(_quantity(wanted.heading) for wanted in model.inputs)}
    free = [name for name in map(_quantity, table.heading) if name not in known]
    other = free[0] if len(free) == 1 else "COLUMN"
    remedy = f"set measurement.reading={other}" if hasattr(model, "reading") else f"rename {other}"
    there = ", ".join(table.heading)
    raise table.error(
        f"column {names[0]} is missing, which holds the readings; there are {there}; {remedy}"
    )


def _input(table: TextTable, wanted: Input, text: str, where: str) -> Any:
    if not text.strip():
        raise table.error(
            f"{where}: is empty; what is known of a reading keeps its value, even where it is missing"
        )
    if wanted.kind is str:
        return text.strip()
    value = table.value(text, where)
    if wanted.kind is int and value != round(value):
        raise table.error(f"{where}: '{text}' is not a whole number")
    return wanted.kind(value)


def _sigmas(
    table: TextTable, column: str | None, rows: Sequence[int], z: Array, shown: str
) -> Array | None:
    """Reads the standard deviations (m,) in `rows` of that column, `shown` being the readings' name; None without
    it."""
    if column is None:
        return None
    if _unit(column) not in ("", _unit(shown)):
        raise table.error(f"column {column}: the unit must be that of {shown}; convert the values")
    cells, values = table.column(column), []
    for row, reading in zip(rows, z, strict=True):
        text, where = cells[row]
        values.append(table.value(text, where))
        if values[-1] <= 0 or (math.isnan(values[-1]) and not math.isnan(reading)):
            raise table.error(
                f"{where}: '{text}' is not a standard deviation; give a number above 0"
            )
    return np.array(values)
