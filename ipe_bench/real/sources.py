"""From files to what is estimated: the readings, the model with the inputs that stand beside them, and their weights.

What a row and a cell may look like is left to `readings`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
    deviations = [one.deviations for one in found if one.deviations is not None]
    joint = Joint(tuple(one.model for one in found))
    return Readings(joint, np.concatenate([one.z for one in found]), np.concatenate(deviations) if deviations else None)


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
    if not path.is_file():
        raise UserError(f"readings={path}: there is no such file")
    heading, rows = readings.cells_of(path)
    columns = [_column_of(i.heading, heading) for i in model.inputs]
    there = [c for i, c in zip(model.inputs, columns, strict=True) if c is not None and not i.label]
    if not model.inputs or (model.input_columns_known and not there):
        z = readings.read_readings(path, model)
        return Readings(model, z, _deviations_by_label(path, model, heading, rows, z))
    place = f"readings={path}"
    for wanted, column in zip(model.inputs, columns, strict=True):
        if column is None and wanted.default is None:
            raise UserError(
                f"{place}: column {wanted.heading} is missing; {model.absent_input(wanted.heading, heading)}"
            )
    if not rows:
        raise UserError(f"{place}: has a header and no rows")
    cells = [dict(zip(heading, row, strict=False)) for _, row in rows]
    numbers = [number for number, _ in rows]
    shown = _reading_column(path, model, heading)
    z = np.array(
        [
            readings.number_in(c.get(shown, ""), f"{place}: row {k}, column {shown}")
            for k, c in zip(numbers, cells, strict=True)
        ]
    )
    known = {
        wanted.heading: [wanted.default] * len(z)
        if column is None
        else [
            _input(wanted, c.get(column, ""), f"{place}: row {k}, column {column}")
            for k, c in zip(numbers, cells, strict=True)
        ]
        for wanted, column in zip(model.inputs, columns, strict=True)
    }
    try:
        informed = model.with_inputs(known, len(z))
    except UserError as error:
        raise UserError(f"{place}: {error}") from None
    if np.isfinite(z).sum() < informed.n:
        raise UserError(f"{place}: {int(np.isfinite(z).sum())} readings are too few for {informed.n} parameters")
    sigma = _column_of(SIGMA, heading)
    texts = [c.get(sigma or "", "") for c in cells]
    deviations = None if sigma is None else _sigmas(path, sigma, texts, numbers, z, model)
    return Readings(informed, z, deviations)


def _column_of(wanted: str, heading: Sequence[str]) -> str | None:
    """The column of that heading; a heading without a unit is found with one, too."""
    if wanted in heading:
        return wanted
    if " [" in wanted:
        return None
    return next((name for name in heading if name.split(" [")[0].strip() == wanted), None)


def _reading_column(path: Path, model: Measurement, heading: Sequence[str]) -> str:
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    candidates = [f"{name}{unit}" for name in dict.fromkeys((model.reading_name, "reading"))]
    for name in candidates:
        column = _column_of(name, heading)
        if column is not None:
            return column
    for name in heading:
        if name.split(" [")[0].strip() in (model.reading_name, "reading"):
            raise UserError(
                f"readings={path}: column {name}: the unit must be that of {candidates[0]}; convert the values"
            )
    raise UserError(
        f"readings={path}: column {candidates[0]} is missing, which holds the readings; there are {', '.join(heading)}"
    )


def _input(wanted: Input, text: str, where: str) -> Any:
    if not text.strip():
        raise UserError(f"{where}: is empty; what is known of a reading keeps its value, even where it is missing")
    if wanted.kind is str:
        return text.strip()
    value = readings.number_in(text, where)
    if wanted.kind is int and value != round(value):
        raise UserError(f"{where}: '{text}' is not a whole number")
    return wanted.kind(value)


def _deviations_by_label(
    path: Path, model: Measurement, heading: Sequence[str], rows: Sequence[tuple[int, list[str]]], z: Array
) -> Array | None:
    """The column sigma in the model's order; the rows are known to be the model's readings."""
    sigma = _column_of(SIGMA, heading)
    if sigma is None:
        return None
    places = {readings.comparable(label): i for i, label in enumerate(zip(*model.index.values(), strict=True))}
    texts, numbers = [""] * model.m, [0] * model.m
    for number, row in rows:
        cells = dict(zip(heading, row, strict=False))
        place = places[readings.comparable(tuple(cells.get(name, "") for name in model.index))]
        texts[place], numbers[place] = cells.get(sigma, ""), number
    return _sigmas(path, sigma, texts, numbers, z, model)


def _sigmas(
    path: Path, column: str, texts: Sequence[str], numbers: Sequence[int], z: Array, model: Measurement
) -> Array:
    unit = column.partition("[")[2].rstrip("] ")
    if unit and model.reading_unit and unit != model.reading_unit:
        raise UserError(
            f"readings={path}: column {column}: the unit must be that of the readings, {model.reading_unit}; convert"
            " the values"
        )
    values = np.full(len(z), np.nan)
    for i, (text, number) in enumerate(zip(texts, numbers, strict=True)):
        where = f"readings={path}: row {number}, column {column}"
        values[i] = readings.number_in(text, where)
        if (not math.isnan(values[i]) and values[i] <= 0) or (math.isnan(values[i]) and not math.isnan(z[i])):
            raise UserError(f"{where}: '{text}' is not a standard deviation; give a number above 0")
    return values


def input_rows(model: Measurement) -> Mapping[str, Sequence[Any]]:
    """What stands in every column but that of the readings."""
    return {**model.index, **model.input_columns}
