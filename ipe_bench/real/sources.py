"""From files to what is estimated: the readings, the model with the inputs that stand beside them, and their weights.

What a row and a cell may look like is left to `readings`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Input, Measurement
from ipe_bench.measurements.joint import Joint
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


def open_together(paths: Sequence[Path], model: Measurement) -> Readings:
    """The readings of one file or of several; the latter share the parameters that are not a file's own.

    Raises:
        UserError: a file is absent or does not hold readings of this model, or files differ in what they know.
    """
    found = [open_readings(path, model) for path in paths]
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


def open_readings(path: Path, model: Measurement) -> Readings:
    """The readings of a file, in the order of the model that comes with them.

    Raises:
        UserError: the file is absent or does not hold readings of this model, by row and column.
    """
    table = readings.read_table(path)
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
        informed = model.with_inputs(known, len(z))
    except UserError as error:
        raise table.error(str(error)) from None
    _require_known(table, model, (*used, *informed.index))
    _require_order(table, informed, [i.heading for i in model.inputs])
    if np.isfinite(z).sum() < informed.n:
        raise table.error(f"{int(np.isfinite(z).sum())} readings are too few for {informed.n} parameters")
    return Readings(informed, z, _sigmas(table, sigma, range(len(z)), z, shown), used)


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
