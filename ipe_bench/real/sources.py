"""From files to what is estimated: the readings, the model with the inputs that stand beside them, and their weights.

What a row and a cell may look like is left to `readings`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Input, Measurement
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, informed
from ipe_bench.noise import Gaussian, Noise, Unknown
from ipe_bench.real import readings
from ipe_bench.real.readings import Table

SIGMA = "sigma"
"""The column of standard deviations of the readings."""


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
        """Those of one of the files."""
        return frozenset(number for which, number in (self._place(row, paths) for row in self.rows) if which == path)

    @staticmethod
    def _place(row: int | str, paths: Sequence[Path]) -> tuple[Path, int]:
        """The file and the number of a row.

        Raises:
            UserError: it names no file of those, or no row.
        """
        name, _, number = str(row).rpartition(":")
        if not number.strip().isascii() or not number.strip().isdigit():
            raise UserError(f"ignore_rows={row}: is not the number of a row; messages name rows by their number")
        if not name and len(paths) == 1:
            return paths[0], int(number)
        if not name:
            raise UserError(f"ignore_rows={row}: says not of which file; write {paths[0]}:{row}")
        known = [path for path in paths if name in (str(path), path.name)]
        if len(known) != 1:
            raise UserError(f"ignore_rows={row}: {unknown(name, [str(path) for path in paths], 'file')}")
        return known[0], int(number)


NOTHING = LeftOut()


def open_together(
    paths: Sequence[Path], model: Measurement, left_out: LeftOut = NOTHING, *, enough: bool = True
) -> Readings:
    """The readings of one file or of several; the latter share the parameters that are not a file's own.

    What is known of parameters (`ConstrainedModel`) is known of all files, where each has its own of each one's.
    `enough`: refuses fewer readings than parameters.

    Raises:
        UserError: a file is absent or does not hold readings of this model, or files differ in what they know.
    """
    if isinstance(model, ConstrainedModel):
        found = open_together(paths, model.whole, left_out, enough=False)
        found = replace(found, model=informed(found.model, model.known))
    else:
        tables = [readings.read_table(path, without=left_out.rows_of(path, paths)) for path in paths]
        _require_columns(tables, left_out.columns)
        found = _together(
            paths,
            [
                _readings_in(_reduced(table, model, left_out.columns, left_out.rows_of(path, paths)), model)
                for path, table in zip(paths, tables, strict=True)
            ],
        )
        found = replace(found, files=tuple((str(table.path), table.digest) for table in tables))
    if enough:
        require_enough(paths, found)
    return found


def require_enough(paths: Sequence[Path], found: Readings) -> None:
    """Refuses fewer readings than parameters."""
    shown = str(paths[0]) if len(paths) == 1 else f"[{','.join(map(str, paths))}]"
    readings.require_enough(lambda text: UserError(f"readings={shown}: {text}"), found.z, found.model)


def _require_columns(tables: Sequence[Table], columns: Sequence[str]) -> None:
    for name in columns:
        if all(_heading_of(name, table) is None for table in tables):
            known = dict.fromkeys(heading for table in tables for heading in table.heading)
            raise UserError(f"ignore_columns={name}: {unknown(name, list(known), 'column')}")


def _heading_of(name: str, table: Table) -> str | None:
    """The column that is meant by a name with its unit or without."""
    return next((h for h in table.heading if name.strip() in (h, h.split(" [")[0].strip())), None)


def _reduced(table: Table, model: Measurement, columns: Sequence[str], rows: Collection[int]) -> Table:
    """The table without these columns, and with the readings missing in these rows."""
    gone = {_heading_of(name, table) for name in columns}
    kept = [k for k, name in enumerate(table.heading) if name not in gone]
    width = len(table.heading)
    numbers = [number for number, _ in table.rows]
    for number in sorted(rows):
        if number not in numbers:
            raise UserError(
                f"ignore_rows={number}: {table.path} has no such row; its rows are {numbers[0]} to {numbers[-1]}"
                if numbers
                else f"ignore_rows={number}: {table.path} has no rows"
            )
    table = replace(
        table,
        heading=[table.heading[k] for k in kept],
        # Of other lengths are only rows that are left out.
        rows=[(number, [row[k] for k in kept]) for number, row in table.rows if len(row) == width],
    )
    if not rows:
        return table
    emptied = [table.heading.index(name) for name in (_reading_column(table, model), SIGMA) if name in table.heading]
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
    columns = [(i, _column_of(i.heading, row.heading)) for i in model.inputs]
    try:
        for wanted, column in columns:
            if column is not None:
                _input(row, wanted, *row.column(column)[0])
    except UserError:
        return False
    return True


def _together(paths: Sequence[Path], found: Sequence[Readings]) -> Readings:
    if len(found) == 1:
        return found[0]
    for one, path in zip(found, paths, strict=True):
        if (one.deviations is None) != (found[0].deviations is None):
            with_sigma, without = (paths[0], path) if one.deviations is None else (path, paths[0])
            raise UserError(f"readings={without}: has no column {SIGMA}, as {with_sigma} has; give it one, too")
        _require_same_units(paths[0], found[0], path, one)
    deviations = [one.deviations for one in found if one.deviations is not None]
    joint = Joint(tuple(one.model for one in found))
    return Readings(joint, np.concatenate([one.z for one in found]), np.concatenate(deviations) if deviations else None)


def _require_same_units(first: Path, known: Readings, path: Path, one: Readings) -> None:
    """Refuses a file whose columns have other units than those of the first: one formula is made of both."""
    units = {name.split(" [")[0]: _unit(name) for name in known.columns}
    for name in one.columns:
        other = units.get(name.split(" [")[0])
        if other and _unit(name) and _unit(name) != other:
            raise UserError(f"readings={path}: column {name}: {first} has it in {other}; convert the values")


def noise_of(found: Readings, stated: Noise | None) -> Noise | None:
    """What is known of the errors: what a user states, or the deviations in the file; None where neither says.

    Raises:
        UserError: both do.
    """
    if found.deviations is None:
        return stated
    deviations = tuple(np.where(np.isfinite(found.deviations), found.deviations, 1.0).tolist())
    if isinstance(stated, Unknown):
        return Unknown(deviations)
    if stated is not None:
        raise UserError(
            f"noise: is given, and the readings have a column {SIGMA}, too; leave one of them out, or set noise=unknown"
            " to take the column for relative weights"
        )
    return Gaussian(deviations)


def _readings_in(table: Table, model: Measurement) -> Readings:
    """The readings of a file, of which there may be too few."""
    sigma = _column_of(SIGMA, table.heading)
    columns = [_column_of(i.heading, table.heading) for i in model.inputs]
    there = [c for i, c in zip(model.inputs, columns, strict=True) if c is not None and not i.label]
    if not model.inputs or (model.input_columns_known and not there):
        rows = readings.rows_of(table, model, [sigma] if sigma else [])
        z = readings.readings_of(table, model, rows)
        return Readings(model, z, _sigmas(table, sigma, rows, z, readings.header(model)[-1]))
    for wanted, column in zip(model.inputs, columns, strict=True):
        if column is None and wanted.default is None:
            raise table.error(
                f"column {wanted.heading} is missing; {model.absent_input(wanted.heading, table.heading)}"
            )
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
    _require_known(table, model, (*used, *sampled.index))
    _require_order(table, sampled, [i.heading for i in model.inputs])
    return Readings(sampled, z, _sigmas(table, sigma, range(len(z)), z, shown), used)


def _require_known(table: Table, model: Measurement, known: Collection[str]) -> None:
    """Refuses columns of which nobody knows what they are for: what reads like weights, say, would not weigh."""
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    wanted = dict.fromkeys((*(i.heading for i in model.inputs), f"{model.reading_name}{unit}", SIGMA))
    table.require_known(known, tuple(wanted))


def _require_order(table: Table, model: Measurement, inputs: Collection[str]) -> None:
    """Refuses other labels than those that the model gives to the rows in their order: outliers would be told by them.

    Raises:
        UserError: by row and column.
    """
    for name, labels in model.index.items():
        if name in inputs or name not in table.heading:
            continue
        for (text, where), label in zip(table.column(name), labels, strict=True):
            if not readings.same_label(table, text, label):
                raise table.error(
                    f"{where}: '{text}' stands where the order of the rows says {label}; leave the column out"
                )


def _column_of(wanted: str, heading: Sequence[str]) -> str | None:
    """The column of that heading; a heading without a unit is found with one, too."""
    if wanted in heading:
        return wanted
    if " [" in wanted:
        return None
    return next((name for name in heading if name.split(" [")[0].strip() == wanted), None)


def _unit(heading: str) -> str:
    return heading.partition("[")[2].rstrip("] ")


def _reading_column(table: Table, model: Measurement) -> str:
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    candidates = [f"{name}{unit}" for name in dict.fromkeys((model.reading_name, "reading"))]
    for name in candidates:
        column = _column_of(name, table.heading)
        if column is not None:
            return column
    for name in table.heading:
        if name.split(" [")[0].strip() in (model.reading_name, "reading"):
            raise table.error(f"column {name}: the unit must be that of {candidates[0]}; convert the values")
    raise table.error(
        f"column {candidates[0]} is missing, which holds the readings; there are {', '.join(table.heading)}"
    )


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


def input_rows(model: Measurement) -> Mapping[str, Sequence[Any]]:
    """What stands in every column but that of the readings."""
    return {**model.index, **model.input_columns}
