"""Files of readings, and the model completed by what stands in them.

A file has one row per reading, with columns that say which reading it is, and the reading with its unit. The header for
GINS is `case,time [min],axis,reading [m/s]`. Rows may stand in any order; an empty reading is missing. Cells are
separated by commas or tabs; or by semicolons, and then a comma is a decimal point, as European spreadsheets write it.
Nothing is guessed: what is not plainly a number, or not part of the table, is refused with its row.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, did_you_mean, unknown
from ipe_bench.basics.files import write_atomically
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Input, Measurement
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, informed

SIGMA = "sigma"
"""The column of standard deviations of the readings."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_WITH_COMMA = re.compile(r"[+-]?\d*,\d*([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Readings:
    """One file of readings, or several."""

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


@dataclass(frozen=True)
class LeftOut:
    """What of the files is left out on purpose.

    A row that is left out is a missing reading: it is predicted with its band, where its other cells can be read.
    """

    columns: tuple[str, ...] = ()
    """Headings, with their units or without; in all files that have them."""
    rows: tuple[int | str, ...] = ()
    """Numbers of rows, as messages and spreadsheets count them; of several files FILE:NUMBER."""

    def __bool__(self) -> bool:
        return bool(self.columns or self.rows)

    @property
    def said(self) -> str:
        """In words; empty where nothing is left out."""
        parts = [("rows", self.rows), ("columns", self.columns)]
        return "; ".join(f"{what} {', '.join(map(str, names))}" for what, names in parts if names)

    def rows_of(self, path: Path, paths: Sequence[Path]) -> frozenset[int]:
        """The rows of one of the files.

        Raises:
            UserError: a row names no file of those, or is no number.
        """
        found = set()
        for row in self.rows:
            name, _, number = str(row).rpartition(":")
            if not (number.strip().isascii() and number.strip().isdigit()):
                raise UserError(f"ignore_rows={row}: is not the number of a row; messages name rows by their number")
            if not name and len(paths) > 1:
                raise UserError(f"ignore_rows={row}: says not of which file; write {paths[0]}:{row}")
            known = [one for one in paths if name in ("", str(one), one.name)]
            if len(known) != 1:
                raise UserError(f"ignore_rows={row}: {unknown(name, [str(one) for one in paths], 'file')}")
            if known[0] == path:
                found.add(int(number))
        return frozenset(found)


# Tables of text -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """A file as text: its header, and its rows with their numbers in the file. Every row has as many cells as the
    header, and no two columns have one name."""

    path: Path
    heading: Sequence[str] = ()
    rows: Sequence[tuple[int, list[str]]] = ()
    decimal: str = "."
    key: str = "readings"
    """The key of the config that names the file."""
    digest: str = ""
    """SHA-256 of the bytes that were read."""

    def error(self, text: str) -> UserError:
        return UserError(f"{self.key}={self.path}: {text}")

    def number(self, text: str) -> float | None:
        """What a cell says in digits that everybody reads alike; None where it says something else."""
        # A point among decimal commas would be one between thousands, or one of another country: nobody can tell.
        return _number(text.replace(".", "?").replace(",", ".") if self.decimal == "," else text)

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

    def find(self, wanted: str) -> str | None:
        """The column of that heading; a heading without a unit is found with one, too."""
        if wanted in self.heading:
            return wanted
        return next((name for name in self.heading if " [" not in wanted and _quantity(name) == wanted), None)

    def require_known(self, known: Collection[str], wanted: Sequence[str]) -> None:
        """Refuses columns that are not known, as what they say would be left out without a word."""
        for name in self.heading:
            if name not in known:
                meant = did_you_mean(name, [one for one in wanted if one not in self.heading])
                what = f"column {name}" if name else f"column {self.heading.index(name) + 1}, which has no name,"
                remedy = f"remove it, or set ignore_columns=[{name.split(' [')[0]}]" if name else "remove it"
                hint = f"{meant} Otherwise" if meant else ";"
                raise self.error(f"{what} is not understood{hint} {remedy} (the header must be {','.join(wanted)})")


def _number(text: str) -> float | None:
    text = text.strip()  # of separators too, which float() does not take
    return float(text) if _NUMBER.fullmatch(text) else None


def _quantity(heading: str) -> str:
    return heading.partition(" [")[0].strip()


def _unit(heading: str) -> str:
    return heading.partition("[")[2].rstrip("] ")


def read_table(path: Path, *, key: str = "readings", without: Collection[int] = ()) -> Table:
    """The header and the rows of a CSV or Parquet file, which `key` names in the config. Rows `without` need not be
    such rows: those with too few or too many cells are left out.

    Raises:
        UserError: the file is absent, or not such a table.
    """
    table = Table(path, key=key)
    if not path.is_file():
        raise table.error("there is no such file")
    data = path.read_bytes()
    table = replace(table, digest=hashlib.sha256(data).hexdigest())
    table = (_with_parquet if path.suffix == ".parquet" else _with_text)(table, data)
    if all(table.number(name) is not None for name in table.heading):
        raise table.error("the first row has only numbers and is no header; write the names of the columns above it")
    for name in table.heading:
        if table.heading.count(name) > 1:
            what = f"column {name} stands there" if name else "columns without a name stand there"
            raise table.error(f"{what} twice; keep one")
    for number, row in table.rows:
        if len(row) != len(table.heading) and number not in without:
            raise table.error(_miscounted(table, number, row))
    return table


def _with_parquet(table: Table, data: bytes) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        found = pq.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        raise table.error("is not a readable Parquet file") from error
    found = found.select([n for n in found.column_names if not n.startswith("__index_level_")])  # pandas' row numbers
    columns = [["" if v is None else str(v) for v in column.to_pylist()] for column in found.columns]
    return replace(table, heading=found.column_names, rows=list(enumerate(map(list, zip(*columns, strict=True)), 1)))


def _with_text(table: Table, data: bytes) -> Table:
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise table.error(f"row {row}: is not a readable CSV file ({error.reason}); save it as CSV in UTF-8") from error
    first = next((line for line in text.splitlines() if line.strip()), "")
    separator = next((sign for sign in ";\t" if sign in first), ",")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    try:
        lines = [(reader.line_num, row) for row in reader if any(c.strip() for c in row)]
    except csv.Error as error:
        raise table.error(f"row {reader.line_num}: is not a readable CSV file ({error}); mend the quotes") from error
    if not lines:
        raise table.error("is empty")
    (_, heading), *rows = lines
    comma = separator == ";" and any(_WITH_COMMA.fullmatch(cell.strip()) for _, row in rows for cell in row)
    return replace(table, heading=[name.strip() for name in heading], rows=rows, decimal="," if comma else ".")


def _miscounted(table: Table, number: int, row: Sequence[str]) -> str:
    """What is wrong with a row that has more or fewer cells than the header."""
    if number == table.rows[0][0] and all(cell.strip() and table.number(cell) is None for cell in row):
        return f"row {number}: looks like the header, which must be the first row; remove what stands above it"
    text = f"row {number}: has {len(row)} cells and the header {len(table.heading)}"
    if len(row) > len(table.heading) and table.decimal == ".":
        return f"{text}; with decimal commas, separate the cells by semicolons"
    return f"{text}; a missing reading is an empty cell"


# Files of a model -----------------------------------------------------------------------------------------------------


def labels(model: Measurement) -> Mapping[str, Sequence[Any]]:
    """What stands in every column but that of the readings."""
    return {**model.index, **model.input_columns}


def header(model: Measurement) -> list[str]:
    """The columns of a readings file of this model."""
    return [*labels(model), f"reading [{model.reading_unit}]" if model.reading_unit else "reading"]


def write_readings(path: Path, model: Measurement, z: Array) -> None:
    """Writes the readings z (m,); a NaN becomes an empty cell.

    Raises:
        UserError: the file is there already.
    """
    rows = zip(*labels(model).values(), ["" if math.isnan(value) else repr(float(value)) for value in z], strict=True)
    _write(path, [header(model), *rows])


def write_truth(path: Path, model: Measurement, x: Array) -> None:
    """Writes parameters x (n,), given in multiples of their sizes, in physical units."""
    values = model.physical(x[None])[0]
    rows = [[p.name, p.unit, repr(float(v))] for p, v in zip(model.physical_parameters, values, strict=True)]
    _write(path, [["parameter", "unit", "value"], *rows])


def _write(path: Path, rows: Sequence[Sequence[Any]]) -> None:
    if path.exists():
        raise UserError(f"{path}: is there already and is not overwritten; name another file or remove it")

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(rows)

    write_atomically(path, write)


def open_together(
    paths: Sequence[Path], model: Measurement, left_out: LeftOut | None = None, *, enough: bool = True
) -> Readings:
    """The readings of one file or of several; the latter share the parameters that are not a file's own.

    What is known of parameters (`ConstrainedModel`) is known of all files, where each has its own of each one's.
    `enough`: refuses fewer readings than parameters.

    Raises:
        UserError: a file is absent or does not hold readings of this model, or files differ in what they know.
    """
    left_out = left_out or LeftOut()
    if isinstance(model, ConstrainedModel):
        found = open_together(paths, model.whole, left_out, enough=False)
        found = replace(found, model=informed(found.model, model.known))
    else:
        rows = [left_out.rows_of(path, paths) for path in paths]
        tables = [read_table(path, without=gone) for path, gone in zip(paths, rows, strict=True)]
        for name in left_out.columns:
            if all(table.find(name.strip()) is None for table in tables):
                known = dict.fromkeys(heading for table in tables for heading in table.heading)
                raise UserError(f"ignore_columns={name}: {unknown(name, list(known), 'column')}")
        reduced = [_reduced(table, model, left_out.columns, gone) for table, gone in zip(tables, rows, strict=True)]
        found = _together(paths, [_readings_in(table, model) for table in reduced])
        found = replace(found, files=tuple((str(table.path), table.digest) for table in tables))
    if enough:
        require_enough(paths, found)
    return found


def require_enough(paths: Sequence[Path], found: Readings) -> None:
    """Refuses fewer readings than parameters."""
    there = int(np.isfinite(found.z).sum())
    if there < found.model.n:
        shown = str(paths[0]) if len(paths) == 1 else f"[{','.join(map(str, paths))}]"
        raise UserError(f"readings={shown}: {there} readings are too few for {found.model.n} parameters")


def _reduced(table: Table, model: Measurement, columns: Sequence[str], rows: Collection[int]) -> Table:
    """The table without these columns, and with the readings missing in these rows."""
    numbers = [number for number, _ in table.rows]
    for number in sorted(rows):
        if number not in numbers:
            there = f"{table.path} has no such row; its rows are {numbers[0]} to {numbers[-1]}" if numbers else ""
            raise UserError(f"ignore_rows={number}: {there or f'{table.path} has no rows'}")
    gone = {table.find(name.strip()) for name in columns}
    kept = [k for k, name in enumerate(table.heading) if name not in gone]
    heading = [table.heading[k] for k in kept]
    # Of other lengths are only rows that are left out.
    same = [(number, [row[k] for k in kept]) for number, row in table.rows if len(row) == len(table.heading)]
    table = replace(table, heading=heading, rows=same)
    if not rows:
        return table
    emptied = [heading.index(name) for name in (_reading_column(table, model), SIGMA) if name in heading]
    found = []
    for number, row in table.rows:
        if number in rows:
            row = ["" if k in emptied else cell for k, cell in enumerate(row)]
            if not _is_known(replace(table, rows=[(number, row)]), model):
                continue
        found.append((number, row))
    return replace(table, rows=found)


def _is_known(row: Table, model: Measurement) -> bool:
    """Whether what a model wants to know of a reading can be read in the one row of a table."""
    try:
        for wanted in model.inputs:
            if column := row.find(wanted.heading):
                _input(row, wanted, *row.column(column)[0])
    except UserError:
        return False
    return True


def _together(paths: Sequence[Path], found: Sequence[Readings]) -> Readings:
    first = found[0]
    if len(found) == 1:
        return first
    units = {name.split(" [")[0]: _unit(name) for name in first.columns}
    for one, path in zip(found, paths, strict=True):
        if (one.deviations is None) != (first.deviations is None):
            with_sigma, without = (paths[0], path) if one.deviations is None else (path, paths[0])
            raise UserError(f"readings={without}: has no column {SIGMA}, as {with_sigma} has; give it one, too")
        for name in one.columns:  # one formula is made of all files
            other = units.get(name.split(" [")[0])
            if other and _unit(name) and _unit(name) != other:
                raise UserError(f"readings={path}: column {name}: {paths[0]} has it in {other}; convert the values")
    deviations = [one.deviations for one in found if one.deviations is not None]
    joint = Joint(tuple(one.model for one in found))
    return Readings(joint, np.concatenate([one.z for one in found]), np.concatenate(deviations) if deviations else None)


def _readings_in(table: Table, model: Measurement) -> Readings:
    """The readings of a file, of which there may be too few."""
    sigma = table.find(SIGMA)
    columns = [table.find(wanted.heading) for wanted in model.inputs]
    there = [c for i, c in zip(model.inputs, columns, strict=True) if c is not None and not i.label]
    if not model.inputs or (model.input_columns_known and not there):
        rows, shown = _rows_of(table, model, [sigma] if sigma else []), header(model)[-1]
        cells = table.column(shown)
        z = np.array([table.value(*cells[row]) for row in rows], dtype=float)
        return Readings(model, z, _sigmas(table, sigma, rows, z, shown))
    for wanted, column in zip(model.inputs, columns, strict=True):
        if column is None and wanted.default is None:
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
    table.require_known((*used, *sampled.index), tuple(dict.fromkeys((*headings, _shown_as(model)[0], SIGMA))))
    for name, values in sampled.index.items():
        if name not in headings and name in table.heading:
            # Outliers would be told by other labels than those that the model gives to the rows in their order.
            for (text, where), label in zip(table.column(name), values, strict=True):
                if _label(text, table.number(text)) != _label_of(label):
                    said = f"'{text}' stands where the order of the rows says {label}; leave the column out"
                    raise table.error(f"{where}: {said}")
    return Readings(sampled, z, _sigmas(table, sigma, range(len(z)), z, shown), used)


def _rows_of(table: Table, model: Measurement, also: Sequence[str]) -> list[int]:
    """Where in the table each of the model's readings stands; `also` names further columns that are understood."""
    wanted = header(model)
    for name in (*model.index, wanted[-1]):
        if name not in table.heading:
            _refuse_other_unit(table, name)
            raise table.error(f"column {name} is missing; the header must be {','.join(wanted)}")
    table.require_known((*wanted, *also), wanted)
    every = list(zip(*model.index.values(), strict=True))
    places = {tuple(map(_label_of, label)): i for i, label in enumerate(every)}
    columns = [table.heading.index(name) for name in model.index]
    found: dict[int, int] = {}
    for k, (number, row) in enumerate(table.rows):
        place = places.get(tuple(_label(row[at], table.number(row[at])) for at in columns))
        if place is None or place in found:
            said = ", ".join(f"{table.heading[at]}={row[at].strip()}" for at in columns)
            if place is None:
                raise table.error(f"row {number}: {model.name} has no reading {said}; correct or remove the row")
            earlier = table.rows[found[place]][0]
            raise table.error(f"row {number}: {said} stands in row {earlier} already; keep one of them")
        found[place] = k
    if len(found) < model.m:
        absent = next(label for i, label in enumerate(every) if i not in found)
        said = ", ".join(f"{name}={value}" for name, value in zip(model.index, absent, strict=True))
        raise table.error(
            f"has {len(found)} of {model.m} rows; the first absent one is {said} "
            "(a missing reading keeps its row, with an empty cell)"
        )
    return [found[i] for i in range(model.m)]


def _label(text: str, number: float | None) -> Any:
    """Labels are compared as numbers where they are numbers: 3 and 3.0 are one."""
    return text.strip() if number is None else round(number, 9)


def _label_of(value: Any) -> Any:
    return _label(str(value), _number(str(value)))


def _shown_as(model: Measurement) -> list[str]:
    """What the column of the readings may be called."""
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    return [f"{name}{unit}" for name in dict.fromkeys((model.reading_name, "reading"))]


def _reading_column(table: Table, model: Measurement) -> str:
    names = _shown_as(model)
    if found := next(filter(None, map(table.find, names)), None):
        return found
    for name in names:
        _refuse_other_unit(table, name)
    known = [_quantity(wanted.heading) for wanted in model.inputs] + [SIGMA]
    free = [_quantity(name) for name in table.heading if _quantity(name) not in known]
    other = free[0] if len(free) == 1 else "COLUMN"
    remedy = f"set measurement.reading={other}" if hasattr(model, "reading") else f"rename {other}"
    there = ", ".join(table.heading)
    raise table.error(f"column {names[0]} is missing, which holds the readings; there are {there}; {remedy}")


def _refuse_other_unit(table: Table, name: str) -> None:
    """Refuses a column that is there with another unit."""
    for other in table.heading:
        if _quantity(other) == _quantity(name):
            raise table.error(f"column {other}: the unit must be that of {name}; convert the values")


def _input(table: Table, wanted: Input, text: str, where: str) -> Any:
    if not text.strip():
        raise table.error(f"{where}: is empty; what is known of a reading keeps its value, even where it is missing")
    if wanted.kind is str:
        return text.strip()
    value = table.value(text, where)
    if wanted.kind is int and value != round(value):
        raise table.error(f"{where}: '{text}' is not a whole number")
    return wanted.kind(value)


def _sigmas(table: Table, column: str | None, rows: Sequence[int], z: Array, shown: str) -> Array | None:
    """The standard deviations (m,) that stand in `rows` of that column, `shown` being that of the readings; None where
    there is no such column."""
    if column is None:
        return None
    if _unit(column) and _unit(column) != _unit(shown):
        raise table.error(f"column {column}: the unit must be that of {shown}; convert the values")
    cells = table.column(column)
    values = np.full(len(z), np.nan)
    for i, row in enumerate(rows):
        text, where = cells[row]
        values[i] = table.value(text, where)
        if (not math.isnan(values[i]) and values[i] <= 0) or (math.isnan(values[i]) and not math.isnan(z[i])):
            raise table.error(f"{where}: '{text}' is not a standard deviation; give a number above 0")
    return values


# A covariance ---------------------------------------------------------------------------------------------------------

PRIOR_COVARIANCE = "prior_covariance"
_NAMED = "parameter"
"""The column of names, where the rows of a file have names too."""


def read_covariance(given: Any, names: Sequence[str]) -> Array:
    """The matrix (n, n) of the parameters `names`, in their order: rows of numbers, or the name of a CSV file.

    A file has a column for every parameter, headed by its name, in any order; its rows are in the order of the columns,
    or have names in a column `parameter`.

    Raises:
        UserError: it is not a matrix of numbers, or of other parameters.
    """
    if isinstance(given, str):
        return _in_file(read_table(Path(given), key=PRIOR_COVARIANCE), names)
    if not isinstance(given, list | tuple) or not given or not all(isinstance(row, list | tuple) for row in given):
        raise UserError(f"{PRIOR_COVARIANCE}={given}: give a matrix, [[1,0.5],[0.5,1]], or a CSV file")
    for i, row in enumerate(given):
        if len(row) != len(given):
            raise UserError(f"{PRIOR_COVARIANCE}: row {i + 1} has {len(row)} numbers and there are {len(given)} rows")
        for value in row:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise UserError(f"{PRIOR_COVARIANCE}: row {i + 1} has '{value}', which is not a number")
    return np.array(given, dtype=float)


def _in_file(table: Table, names: Sequence[str]) -> Array:
    headings = [name for name in table.heading if name != _NAMED]
    for name in headings:
        if name not in names:
            raise table.error(f"column {name}: {unknown(name, names, 'parameter that is estimated')}")
    for name in names:
        if name not in headings:
            raise table.error(f"has no column {name}; every parameter that is estimated has one")
    rows = headings
    if _NAMED in table.heading:
        rows = [text.strip() for text, _ in table.column(_NAMED)]
        for name, (_, where) in zip(rows, table.column(_NAMED), strict=True):
            if name not in names or rows.count(name) > 1:
                raise table.error(f"{where}: '{name}' is not the name of one parameter, once")
    if len(table.rows) != len(names):
        raise table.error(f"has {len(table.rows)} rows and {len(headings)} parameters; give a row for each")
    found = np.empty((len(names), len(names)))
    for name in headings:
        for row, (text, where) in zip(rows, table.column(name), strict=True):
            if not text.strip():
                raise table.error(f"{where}: is empty; give 0 where two do not depend on each other")
            found[names.index(row), names.index(name)] = table.value(text, where)
    return found
