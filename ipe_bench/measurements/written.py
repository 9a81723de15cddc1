"""What the models share that users write out as formulas or as a function: parameters with a start, and columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, did_you_mean
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Input, Measurement, Parameter


class WrittenModel(Measurement):
    """A model whose parameters are names with a start; `start`, `columns` and `unit` are options of every such model.

    The size of a parameter is the magnitude of its start, or 1 where that is 0, unless `size` says otherwise.
    """

    start: Mapping[str, float]
    columns: Mapping[str, Sequence[float]]
    unit: str
    size: Mapping[str, float] = {}
    units: Mapping[str, str] = {}

    headings: tuple[str, ...]
    """The names of the columns that it takes from the readings."""
    reading: str

    reading_unit = property(lambda model: model.unit)  # type: ignore[assignment]
    reading_name = property(lambda model: model.reading)  # type: ignore[assignment]

    @cached_property
    def starts(self) -> dict[str, float]:
        """The parameters with their starts, in the order of x."""
        return {name: float(value) for name, value in self.start.items()}

    @property
    def parameter_units(self) -> Mapping[str, str]:
        return self.units

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        sizes = {name: abs(value) or 1.0 for name, value in self.starts.items()} | dict(self.size)
        return tuple(Parameter(name, self.parameter_units.get(name, ""), float(sizes[name])) for name in self.starts)

    @cached_property
    def nominal(self) -> Array:
        return np.array(list(self.starts.values())) / self.sizes

    @property
    def inputs(self) -> tuple[Input, ...]:
        return tuple(map(Input, self.headings))

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        return {name: self.column(name).tolist() for name in self.headings}

    def column(self, name: str) -> Array:
        if name not in self.columns:
            raise UserError(
                f"measurement: {name} is neither a column nor a parameter; give a parameter its start, "
                f"measurement.start.{name}=VALUE, or the column, by readings=FILE or measurement.columns.{name}=[...]"
            )
        return np.asarray(self.columns[name], dtype=float)

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"row": list(range(1, self.m + 1)), **self.input_columns}

    def absent_input(self, heading: str, columns: Sequence[str]) -> str:
        remedy = f"If {heading} is a parameter, give it a start: measurement.start.{heading}=VALUE"
        return f"there are {', '.join(columns)}{did_you_mean(heading, columns) or '.'} {remedy}"

    def require_equal_lengths(self) -> None:
        """Refuses columns of different lengths."""
        lengths = {name: len(column) for name, column in self.columns.items()}
        if len(set(lengths.values())) > 1:
            raise UserError(f"columns: have different lengths: {lengths}")
