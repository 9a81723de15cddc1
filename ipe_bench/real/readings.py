"""Reads files of readings, and completes the model by their columns.

A file has one row per reading, in any order, with columns that say which reading it is, and the
reading with its unit: `case,time [min],axis,reading [m/s]` for GINS. An empty reading is missing.
Cells are separated by commas or tabs; or by semicolons, and then a comma is a decimal point. What
is not plainly a number is refused with its row.
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
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, did_you_mean, unknown
from ipe_bench.basics.files import fault_of, write_text
from ipe_bench.basics.linalg import Array, unmasked
from ipe_bench.measurements.base import Input, Measurement, labels, with_unit
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo, informed

SIGMA = "sigma"
"""The column of standard deviations of the readings."""
_DATE = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}\b")
_IN_PARENTHESES = re.compile(r"\s*(?P<name>[^\[(]+?)\s+\((?P<unit>[^()]*)\)\s*")
"""A heading with its unit behind a blank."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NOT_FINITE = ("nan", "inf", "infinity")
_MISSING = "a missing reading is an empty cell"
_FIRST_ROWS = 100
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


def given_readings(given: Any) -> Array:
    """Returns readings that are given as numbers, NaN where one is masked or missing."""
    if np.iscomplexobj(given):
        raise UserError("readings: are complex; give real numbers")
    z = unmasked(given).copy()
    if np.isinf(z).any():
        raise UserError("readings: inf is not a reading; give NaN if it is missing")
    if np.isnan(z).all():
        raise UserError("readings: there is no reading; all are missing")
    return z


# Tables of text -----------------------------------------------------------------------------------


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
        """Parses the number in a cell, or None; a point among decimal commas is ambiguous, and
        none."""
        if self.decimal == ",":
            text = text.replace(".", "?").replace(",", ".")
        return _number(text)

    def value(self, text: str, where: str) -> float:
        """Parses the finite number in a cell, NaN if it is empty; otherwise a UserError at `where`,
        its row and column."""
        bare = text.strip()
        if not bare:
            return math.nan
        value = self.number(text)
        if value is not None and math.isfinite(value):
            return value
        if value is not None or bare.lstrip("+-").lower() in _NOT_FINITE:
            raise self.error(
                f"{where}: {bare} is not a reading; leave the cell empty if it is missing"
            )
        said = f"'{' '.join(text.split())}' is not a number"
        if self.decimal == ",":
            said += ", with decimal commas"
        if _DATE.match(bare):
            raise self.error(
                f"{where}: {said}; write dates as numbers, such as days since the first"
            )
        raise self.error(f"{where}: {said}; correct it, or leave the cell empty if it is missing")

    def column(self, name: str) -> list[tuple[str, str]]:
        """Lists the texts of a column, each with the words that name its place."""
        at = self.heading.index(name)
        return [(row[at], f"row {number}, column {name}") for number, row in self.rows]

    def numbers(self, name: str) -> list[float]:
        """Parses the finite numbers of a column, NaN where a cell is empty.

        Raises:
            UserError: another cell is there.
        """
        at = self.heading.index(name)
        cells = [row[at].strip() for _, row in self.rows]
        # Of numbers alone nothing needs the name of a cell's place.
        if self.decimal == "." and all(map(_NUMBER.fullmatch, cells)):
            values = list(map(float, cells))
            if all(map(math.isfinite, values)):
                return values
        return [self.value(*cell) for cell in self.column(name)]

    def find(self, wanted: str) -> str | None:
        """Finds the column of that heading; a heading without a unit is found with one, too."""
        if wanted in self.heading:
            return wanted
        alike = [name for name in self.heading if quantity(name) == quantity(wanted)]
        if quantity(wanted) != wanted:
            return next((name for name in alike if unit_of(name) == unit_of(wanted)), None)
        return next(iter(alike), None)

    def require_known(self, known: Collection[str], wanted: Sequence[str]) -> None:
        """Refuses columns that are not known."""
        for place, name in enumerate(self.heading):
            if name in known:
                continue
            what = f"column {place + 1}, which has no name,"
            remedy = "remove it"
            if name:
                what = f"column {name}"
                alike = [one for one in self.heading if quantity(one) == quantity(name)]
                short = f"'{name}'" if alike[1:] else quantity(name)
                remedy = f"remove it, or set ignore_columns=[{short}]"
            meant = did_you_mean(name, [one for one in wanted if one not in self.heading])
            hint = f"{meant} Otherwise" if meant else ";"
            raise self.error(
                f"{what} is not understood{hint} {remedy} (the header must be {','.join(wanted)})"
            )

    def refuse_other_unit(self, name: str) -> None:
        """Refuses a column that is there with another unit, or with none."""
        for other in self.heading:
            if quantity(other) != quantity(name):
                continue
            if not unit_of(other):
                raise self.error(
                    f"column {other}: has no unit; call it {name} if that is the unit of its values"
                )
            raise self.error(
                f"column {other}: the unit must be the unit of {name}; convert the values"
            )


def _number(text: str) -> float | None:
    text = text.strip()  # of separators too, which float() does not take
    return float(text) if _NUMBER.fullmatch(text) else None


def quantity(heading: str) -> str:
    """Returns a heading such as `height [m]` or `height (m)` without its unit."""
    in_parentheses = _IN_PARENTHESES.fullmatch(heading)
    if in_parentheses:
        return in_parentheses["name"]
    return heading.partition(" [")[0].strip()


def unit_of(heading: str) -> str:
    """Returns the unit of a heading such as `height [m]` or `height (m)`; empty if it has none."""
    in_parentheses = _IN_PARENTHESES.fullmatch(heading)
    if in_parentheses:
        return in_parentheses["unit"]
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
    return [_reduced(table, without) for table in tables]


def _reduced(table: TextTable, without: Sequence[str]) -> TextTable:
    """Leaves columns out of a table."""
    if not without:
        return table
    for name in without:
        alike = [one for one in table.heading if quantity(one) == name]
        if alike[1:] and name not in table.heading:
            raise table.error(
                f"ignore_columns={name}: columns {' and '.join(alike)} have that name; write the"
                " unit, too"
            )
    gone = {table.find(name.strip()) for name in without}
    kept = [k for k, name in enumerate(table.heading) if name not in gone]
    heading = [table.heading[k] for k in kept]
    rows = [(number, [row[k] for k in kept]) for number, row in table.rows]
    return replace(table, heading=heading, rows=rows)


def read_headings(path: Path) -> Sequence[str]:
    """Reads the headings of a file; of its rows the first alone, among which a header that stands
    too low is found.

    Raises:
        UserError: the file is absent or not a table.
    """
    return _read_table(path, _FIRST_ROWS).heading


def _read_table(path: Path, most: int | None = None) -> TextTable:
    """Reads the table of a CSV or Parquet file, or its first rows, at most so many, in which every
    row has as many cells as the header."""
    if path.parent == _SAMPLES and not path.is_file():
        path = Path(__file__).with_name("samples") / path.name
    fault = fault_of(path)
    if fault:
        raise TextTable(path).error(fault)
    data = path.read_bytes()
    table = TextTable(path, digest=hashlib.sha256(data).hexdigest())
    table = (_with_parquet if path.suffix.lower() == ".parquet" else _with_text)(table, data, most)
    _require_header(table)
    for number, row in table.rows:
        if len(row) != len(table.heading):
            raise table.error(f"row {number}: {_wrong_length(table, number, row)}")
    return table


def _require_header(table: TextTable) -> None:
    """Refuses a first row of numbers, and names that stand twice."""
    if all(table.number(name) is not None for name in table.heading):
        raise table.error(
            "the first row has only numbers and is no header; write the names of the columns"
            " above it"
        )
    for name, count in Counter(table.heading).items():
        if count > 1:
            what = f"column {name} is there" if name else "columns without a name are there"
            raise table.error(f"{what} twice; keep one")


def _wrong_length(table: TextTable, number: int, row: Sequence[str]) -> str:
    """Says why a row has more or fewer cells than the header, and what mends it."""
    first, _ = table.rows[0]
    if number == first and all(cell.strip() and table.number(cell) is None for cell in row):
        return "looks like the header, which must be the first row; remove what is above it"
    remedy = _MISSING
    if len(row) > len(table.heading) and table.decimal == ".":
        remedy = "with decimal commas, separate the cells by semicolons"
    return f"has {len(row)} cells and the header {len(table.heading)}; {remedy}"


def _with_parquet(table: TextTable, data: bytes, most: int | None) -> TextTable:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        found = pq.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        raise table.error("is not a readable Parquet file") from error
    # pandas writes the numbers of rows as a column of such a name.
    heading = [name for name in found.column_names if not name.startswith("__index_level_")]
    columns = [
        ["" if cell is None else str(cell) for cell in column.to_pylist()]
        for column in found.select(heading).slice(0, most).columns
    ]
    rows = map(list, zip(*columns, strict=True))
    return replace(table, heading=heading, rows=list(enumerate(rows, 1)))


def _with_text(table: TextTable, data: bytes, most: int | None) -> TextTable:
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
        filled = ((reader.line_num, row) for row in reader if any(map(str.strip, row)))
        lines = list(islice(filled, most))
    except csv.Error as error:
        raise table.error(
            f"row {reader.line_num}: cannot be read as CSV ({error}); fix the quotes"
        ) from error
    if not lines:
        raise table.error("is empty")
    (_, first_row), *rows = lines
    heading = [name.strip() for name in first_row]
    # Only where semicolons part the cells can a comma be a decimal point, and one number with it is
    # enough.
    cells = (cell.strip() for _, row in rows for cell in row)
    comma = separator == ";" and any(map(_WITH_COMMA.fullmatch, cells))
    return replace(table, heading=heading, rows=rows, decimal="," if comma else ".")


# Files of a model ---------------------------------------------------------------------------------


def header(model: Measurement) -> list[str]:
    """Returns the columns of a readings file of this model."""
    return [*labels(model), with_unit("reading", model.reading_unit)]


def write_readings(path: Path, model: Measurement, z: Array) -> None:
    """Writes the readings z (m,); a NaN becomes an empty cell.

    Raises:
        UserError: the file is there already.
    """
    cells = ["" if math.isnan(value) else repr(float(value)) for value in z]
    _write(path, [header(model), *zip(*labels(model).values(), cells, strict=True)])


def write_truth(path: Path, model: Measurement, x: Array) -> None:
    """Writes parameters x (n,), given in multiples of their sizes, in physical units."""
    rows = [["parameter", "unit", "value"]]
    for p, value in zip(model.physical_parameters, model.physical(x[None])[0], strict=True):
        rows.append([p.name, p.unit, repr(float(value))])
    _write(path, rows)


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

    `known` is what is known of all their parameters. `without` are columns that are left out, by
    their headings with their units or without.

    Raises:
        UserError: a file is absent or does not hold readings of this model, files differ in what
            they know, or there are fewer readings than parameters.
    """
    if isinstance(model, ConstrainedModel):
        return open_together(paths, model.whole, (*model.known, *known), without)
    tables = read_tables(paths, without)
    found = _together(paths, [_readings_in(table, model) for table in tables])
    model = informed(found.model, known)
    there = int(np.isfinite(found.z).sum())
    if there < model.n:
        shown = str(paths[0]) if len(paths) == 1 else f"[{','.join(map(str, paths))}]"
        count = "1 reading is" if there == 1 else f"{there} readings are"
        raise UserError(
            f"readings={shown}: {count} too few for {model.n} parameters; take more readings, or"
            " fix a parameter by parameters.NAME.fixed=VALUE"
        )
    files = tuple((str(table.path), table.digest) for table in tables)
    return replace(found, model=model, files=files)


def _together(paths: Sequence[Path], found: Sequence[Readings]) -> Readings:
    """Joins the readings of files."""
    first = found[0]
    if len(found) == 1:
        return first
    units = {quantity(name): unit_of(name) for name in first.columns}
    for one, path in zip(found, paths, strict=True):
        if (one.deviations is None) != (first.deviations is None):
            with_sigma, without = (paths[0], path) if one.deviations is None else (path, paths[0])
            raise UserError(
                f"readings={without}: has no column {SIGMA}, as {with_sigma} has; give it one, too"
            )
        for name in one.columns:  # one formula is made of all files
            other = units.get(quantity(name))
            if other and unit_of(name) and unit_of(name) != other:
                raise UserError(
                    f"readings={path}: column {name}: {paths[0]} has it in {other}; convert the"
                    " values"
                )
    joint = Joint(tuple(one.model for one in found))
    z = np.concatenate([one.z for one in found])
    deviations = [one.deviations for one in found if one.deviations is not None]
    return Readings(joint, z, np.concatenate(deviations) if deviations else None)


def _readings_in(table: TextTable, model: Measurement) -> Readings:
    """Reads a file, which may have too few readings."""
    given = table
    table = _stacked(table, model)
    sigma = table.find(SIGMA)
    columns = {wanted: table.find(wanted.heading) for wanted in model.inputs}
    if not columns or _knows_rows(model, columns):
        shown = header(model)[-1]
        rows = _rows_of(table, model, [sigma] if sigma else [])
        cells = table.column(shown)
        z = np.array([table.value(*cells[row]) for row in rows], dtype=float)
        return Readings(model, z, _sigmas(table, sigma, rows, z, shown))
    for wanted, column in columns.items():
        if column is None and wanted.default is None:
            table.refuse_other_unit(wanted.heading)
            absent = model.absent_input(wanted.heading, list(given.heading))
            raise table.error(f"column {wanted.heading} is missing; {absent}")
    if not table.rows:
        raise table.error("has a header and no rows")
    shown = _reading_column(table, model)
    used = (*filter(None, columns.values()), shown, *([sigma] if sigma else []))
    z = np.array(table.numbers(shown))
    known = {wanted.heading: _entries(table, wanted, column) for wanted, column in columns.items()}
    try:
        sampled = model.with_inputs(known, len(z))
    except UserError as error:
        raise table.error(str(error)) from None
    if len(sampled.periods):
        _require_unit_of_angles(table, shown, sampled)
    wanted = tuple(dict.fromkeys((*known, _shown_as(model)[0], SIGMA)))
    table.require_known((*used, *sampled.index), wanted)
    for name, values in sampled.index.items():
        if name not in known and name in table.heading:
            _require_order(table, name, values)
    own = tuple(name for name in given.heading if name not in table.heading)
    sigmas = _sigmas(table, sigma, range(len(z)), z, shown)
    return Readings(sampled, z, sigmas, (*used, *own))


def _stacked(table: TextTable, model: Measurement) -> TextTable:
    """Gives each reading a row of its own, where a table has a column of readings for each choice
    of a label, such as prey and predator for output, and perhaps of their standard deviations."""
    for label in model.inputs:
        found = {choice: table.find(choice) for choice in label.choices}
        columns = {choice: name for choice, name in found.items() if name is not None}
        if columns and not any(map(table.find, (label.heading, *_shown_as(model)))):
            _require_units(table, columns, model)
            return _stack(table, label.heading, columns, model.reading_unit)
    return table


def _require_units(table: TextTable, columns: Mapping[str, str], model: Measurement) -> None:
    """Refuses columns of readings in another unit than the model's: where some are angles, that is
    theirs."""
    angles = getattr(model, "circular", ())
    for choice, name in columns.items():
        if choice in angles:
            _require_unit_of_angles(table, name, model)
        if choice in angles or not angles:
            wanted = model.unit_of(choice)
            if wanted and unit_of(name) not in ("", wanted):
                raise table.error(f"column {name}: the unit must be {wanted}; convert the values")


def _stack(table: TextTable, label: str, columns: Mapping[str, str], stated: str = "") -> TextTable:
    """Stacks columns of readings, whose unit may be stated."""
    found = {choice: table.find(f"{SIGMA}_{choice}") for choice in columns}
    sigmas = {choice: name for choice, name in found.items() if name is not None}
    parts = {"reading": columns}
    if sigmas:
        parts[SIGMA] = sigmas
    for choice in columns:
        if sigmas and choice not in sigmas:
            raise table.error(f"column {SIGMA}_{choice} is missing beside the others'")
        if sigmas and table.find(SIGMA):
            raise table.error(f"has columns {SIGMA} and {sigmas[choice]}; remove one of them")
        if sigmas:
            _require_same_unit(table, sigmas[choice], columns[choice])
    own = {name for part in parts.values() for name in part.values()}
    kept = [place for place, name in enumerate(table.heading) if name not in own]
    heading = [*(table.heading[place] for place in kept), label]
    units = {stated or unit_of(name) for name in columns.values()}
    unit = units.pop() if len(units) == 1 else ""
    heading += [with_unit(part, unit) for part in parts]
    rows = []
    for number, row in table.rows:
        for choice in columns:
            places = [table.heading.index(part[choice]) for part in parts.values()]
            for place in places:
                # A fault is told by the file's own column.
                table.value(row[place], f"row {number}, column {table.heading[place]}")
            cells = [row[place] for place in (*kept, *places)]
            cells.insert(len(kept), choice)
            rows.append((number, cells))
    return replace(table, heading=heading, rows=rows)


def _knows_rows(model: Measurement, columns: Mapping[Input, str | None]) -> bool:
    """Tells whether the model has its inputs, so that a file without them holds its readings by
    their labels."""
    measured = [wanted for wanted in columns if not wanted.label]
    if not model.input_columns_known or any(columns[wanted] for wanted in measured):
        return False
    # An input that tells readings apart, such as the time, is in every file.
    return not any(wanted.heading in model.index for wanted in measured)


def _entries(table: TextTable, wanted: Input, column: str | None) -> list[Any]:
    """Reads the values of an input, one for each row; its default if there is no such column."""
    if column is None:
        return [wanted.default] * len(table.rows)
    if wanted.kind is float:
        values = table.numbers(column)
        if not any(map(math.isnan, values)):
            return values
    return [_input(table, wanted, *cell) for cell in table.column(column)]


def _require_order(table: TextTable, name: str, values: Sequence[Any]) -> None:
    """Refuses a column that numbers the rows otherwise than their order does."""
    for (text, where), label in zip(table.column(name), values, strict=True):
        if _label(text, table.number) != _label(str(label)):
            raise table.error(
                f"{where}: '{text}' is out of order, which says {label}; leave the column out"
            )


def _rows_of(table: TextTable, model: Measurement, also: Sequence[str]) -> list[int]:
    """Finds the row of each of the model's readings in the table; `also` names further columns that
    are understood."""
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
        cells = [row[at] for at in columns]
        place = places.get(tuple(_label(cell, table.number) for cell in cells))
        if place is None:
            said = _said(model, [cell.strip() for cell in cells])
            raise table.error(
                f"row {number}: {model.name} has no reading {said}; correct or remove the row"
            )
        if place in found:
            said = _said(model, [cell.strip() for cell in cells])
            earlier, _ = table.rows[found[place]]
            raise table.error(f"row {number}: {said} is in row {earlier} already; keep one of them")
        found[place] = k
    if len(found) < model.m:
        absent = next(label for i, label in enumerate(every) if i not in found)
        raise table.error(
            f"has {len(found)} of {model.m} rows; the first absent one is {_said(model, absent)} "
            "(a missing reading keeps its row, with an empty cell)"
        )
    return [found[i] for i in range(model.m)]


def _said(model: Measurement, label: Sequence[Any]) -> str:
    """Names a reading by its label."""
    return ", ".join(f"{name}={value}" for name, value in zip(model.index, label, strict=True))


def _label(text: str, number: Callable[[str], float | None] = _number) -> Any:
    """Converts a label to a number if it is one: 3 and 3.0 are one."""
    value = number(text)
    return text.strip() if value is None else round(value, 9)


def _shown_as(model: Measurement) -> list[str]:
    """Returns the names that the column of the readings may have."""
    names = dict.fromkeys((model.reading_name, "reading"))
    return [with_unit(name, model.reading_unit) for name in names]


def _reading_column(table: TextTable, model: Measurement) -> str:
    names = _shown_as(model)
    found = next(filter(None, map(table.find, names)), None)
    if found:
        return found
    for name in names:
        table.refuse_other_unit(name)
    known = {SIGMA, *(quantity(wanted.heading) for wanted in model.inputs)}
    free = [name for name in map(quantity, table.heading) if name not in known]
    other = free[0] if len(free) == 1 else "COLUMN"
    remedy = f"set measurement.reading={other}" if hasattr(model, "reading") else f"rename {other}"
    there = ", ".join(table.heading)
    raise table.error(f"column {names[0]} of the readings is missing; there are {there}; {remedy}")


def _require_unit_of_angles(table: TextTable, heading: str, model: Measurement) -> None:
    """Refuses a unit of angles that the model, which takes them for radians, does not state: a
    whole turn is another number in it."""
    unit = unit_of(heading)
    angles = getattr(model, "circular", ()) or (model.reading_name,)
    if any(map(model.unit_of, angles)) or unit in ("", "rad"):
        return
    remedy = "convert the values to rad"
    if unit in ("deg", "°"):
        remedy = f"set measurement.unit={unit}"
    raise table.error(f"column {heading}: angles without measurement.unit are in rad; {remedy}")


def _input(table: TextTable, wanted: Input, text: str, where: str) -> Any:
    if not text.strip():
        raise table.error(
            f"{where}: is empty; what is known of a reading keeps its value, even where it is"
            " missing"
        )
    if wanted.kind is str:
        return text.strip()
    value = table.value(text, where)
    if wanted.kind is int and value != round(value):
        raise table.error(f"{where}: '{text}' is not a whole number")
    return wanted.kind(value)


def _require_same_unit(table: TextTable, column: str, shown: str) -> None:
    """Refuses standard deviations in another unit than that of the readings."""
    if unit_of(column) not in ("", unit_of(shown)):
        raise table.error(
            f"column {column}: the unit must be the unit of {shown}; convert the values"
        )


def _sigmas(
    table: TextTable, column: str | None, rows: Sequence[int], z: Array, shown: str
) -> Array | None:
    """Reads the standard deviations (m,) in `rows` of that column, `shown` being the readings'
    name; None without it."""
    if column is None:
        return None
    _require_same_unit(table, column, shown)
    cells = table.column(column)
    values = []
    for row, reading in zip(rows, z, strict=True):
        text, where = cells[row]
        value = table.value(text, where)
        absent = math.isnan(value) and not math.isnan(reading)
        if value <= 0 or absent:
            raise table.error(
                f"{where}: '{text}' is not a standard deviation; give a number above 0"
            )
        values.append(value)
    return np.array(values)
