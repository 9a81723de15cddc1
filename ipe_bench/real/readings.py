"""Files of readings: one row per reading, with columns that say which reading it is, and the reading with its unit.

The header for GINS is `case,time [min],axis,reading [m/s]`. Rows may stand in any order; an empty reading is missing.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_atomically
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Measurement


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
    values = model.natural(x[None])[0]
    rows = [[p.name, p.unit, repr(float(v))] for p, v in zip(model.natural_parameters, values, strict=True)]
    _write(path, ["parameter", "unit", "value"], rows)


def _write(path: Path, heading: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    if path.exists():
        raise UserError(f"{path}: is there already and is not overwritten; name another file or remove it")

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([heading, *rows])

    write_atomically(path, write)


def read_readings(path: Path, model: Measurement) -> Array:
    """The readings z (m,) of a file, in the model's order; NaN where a cell is empty.

    Raises:
        UserError: the file is absent or does not hold this model's readings, by row and column.
    """
    if not path.is_file():
        raise UserError(f"readings={path}: there is no such file")
    heading, rows = cells_of(path)
    wanted = [*model.index, header(model)[-1]]
    _check_header(path, heading, wanted)
    places = {comparable(label): i for i, label in enumerate(zip(*model.index.values(), strict=True))}
    z = np.full(model.m, np.nan)
    seen: dict[int, int] = {}
    for number, row in rows:
        cells = dict(zip(heading, row, strict=False))
        label = tuple(cells.get(name, "") for name in model.index)
        said = ", ".join(f"{name}={value}" for name, value in zip(model.index, label, strict=True))
        place = places.get(comparable(label))
        if place is None:
            raise UserError(
                f"readings={path}: row {number}: {model.name} has no reading {said}; correct or remove the row"
            )
        if place in seen:
            raise UserError(
                f"readings={path}: row {number}: {said} stands in row {seen[place]} already; keep one of them"
            )
        seen[place] = number
        z[place] = number_in(cells.get(wanted[-1], ""), f"readings={path}: row {number}, column {wanted[-1]}")
    if len(seen) < model.m:
        absent = next(label for i, label in enumerate(zip(*model.index.values(), strict=True)) if i not in seen)
        said = ", ".join(f"{name}={value}" for name, value in zip(model.index, absent, strict=True))
        raise UserError(
            f"readings={path}: has {len(seen)} of {model.m} rows; the first absent one is {said} "
            "(a missing reading keeps its row, with an empty cell)"
        )
    if np.isnan(z).sum() > model.m - model.n:
        raise UserError(f"readings={path}: {int((~np.isnan(z)).sum())} readings are too few for {model.n} parameters")
    return z


def cells_of(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Header and numbered rows as text, from CSV or Parquet."""
    if path.suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            table = pq.read_table(path)
        except (pa.ArrowException, OSError) as error:
            raise UserError(f"readings={path}: is not a readable Parquet file") from error
        columns = [["" if v is None else str(v) for v in column.to_pylist()] for column in table.columns]
        return table.column_names, list(enumerate(map(list, zip(*columns, strict=True)), 1))
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [(number, row) for number, row in enumerate(csv.reader(file), 1) if any(c.strip() for c in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"readings={path}: is not a readable CSV file ({error})") from error
    if not lines:
        raise UserError(f"readings={path}: is empty")
    return [name.strip() for name in lines[0][1]], lines[1:]


def _check_header(path: Path, heading: Sequence[str], wanted: Sequence[str]) -> None:
    for name in wanted:
        if name in heading:
            continue
        quantity = name.split(" [")[0]
        other = next((h for h in heading if h.split(" [")[0] == quantity), None)
        if other is not None:
            raise UserError(f"readings={path}: column {other}: the unit must be that of {name}; convert the values")
        raise UserError(f"readings={path}: column {name} is missing; the header must be {','.join(wanted)}")
    repeated = [name for name in wanted if list(heading).count(name) > 1]
    if repeated:
        raise UserError(f"readings={path}: column {repeated[0]} stands there twice; keep one")


def comparable(values: Sequence[Any]) -> tuple[Any, ...]:
    """Labels compared as numbers where they are numbers: 3 and 3.0 are one."""
    return tuple(_number(value) for value in values)


def _number(value: Any) -> Any:
    try:
        return round(float(value), 9)
    except ValueError:
        return str(value).strip()


def number_in(text: str, where: str) -> float:
    if not text.strip():
        return math.nan
    try:
        value = float(text)
    except ValueError:
        raise UserError(
            f"{where}: '{text}' is not a number; correct it, or leave the cell empty if it is missing"
        ) from None
    if not math.isfinite(value):
        raise UserError(f"{where}: {text} is not a reading; leave the cell empty if it is missing")
    return value
