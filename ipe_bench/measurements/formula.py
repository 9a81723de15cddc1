"""A measurement model that is one formula: no plugin, no Python, only its text and the columns of a file.

The text is read by `arithmetic` and recorded by `ode.trace`, which differentiates it exactly; here the recording is
carried out on arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.arithmetic import (
    Arithmetic,
    comparisons,
    never_switches,
    read,
    require_finite,
    require_parameters,
)
from ipe_bench.measurements.ode.trace import Graph, Program, tangent
from ipe_bench.measurements.written import WrittenModel


@dataclass(frozen=True)
class Formula(WrittenModel):
    """z = expression, in which every name with a start is a parameter and every other one a column of the readings.

        ipe-bench estimate measurement=formula "measurement.expression=b1*(1-exp(-b2*t))" \\
            measurement.start.b1=500 measurement.start.b2=1e-4 readings=my.csv

    The language is that of `ipe_bench.measurements.arithmetic`: + - * / ** and elementary functions, angles in rad.
    Parameters stand in the order of their starts, each in multiples of its magnitude; they have no units but those that
    the formula gives them. Readings have the order of the file, and no epochs.
    """

    expression: str
    start: Mapping[str, float] = field(default_factory=dict)
    """Where estimation begins, for each parameter: the nominal point."""
    columns: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """What is known of each reading: the same columns as in a file, for `run`, which has no file."""
    readings: int | None = None
    """Number of readings; None: the length of the columns."""
    reading: str = "y"
    """What the column of the readings is called in a file; `reading` is understood too."""
    unit: str = ""
    """Unit of the readings."""
    own: tuple[str, ...] = ()
    """Parameters of which every file of readings has its own, where there are several."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in self.start.items():
            require_finite(f"start.{name}", value)
            if name not in self.arithmetic.names:
                wanted = ", ".join(self.arithmetic.names)
                raise UserError(f"start.{name}: does not appear in the expression, whose names are {wanted}")
        if not self.start:
            name = next(iter(self.arithmetic.names), "NAME")
            raise UserError(
                f"start: is empty, so nothing is to be estimated; give each parameter a start: start.{name}=1"
            )
        if self.reading in self.arithmetic.names:
            raise UserError(f"reading={self.reading}: stands in the expression too; what is measured cannot explain it")
        self.require_equal_lengths()
        require_parameters("own", self.own, self.start)

    @cached_property
    def arithmetic(self) -> Arithmetic:
        return read(self.expression, "expression")

    own_parameters = property(lambda model: model.own)  # type: ignore[assignment]

    @cached_property
    def headings(self) -> tuple[str, ...]:
        return tuple(name for name in self.arithmetic.names if name not in self.start)

    @property
    def input_columns_known(self) -> bool:
        return bool(self.columns) or self.readings is not None

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Formula:
        return replace(self, columns=dict(columns), readings=readings)

    @cached_property
    def m(self) -> int:
        if self.readings is not None:
            return self.readings
        return len(self.column(self.headings[0])) if self.headings else 0

    @cached_property
    def _recorded(self) -> tuple[Program, Program]:
        """The formula, and its derivative by each parameter, from the values of its names."""
        graph = Graph()
        known = {name: graph.input(name) for name in self.arithmetic.names}
        try:
            with np.errstate(all="raise", under="ignore"):
                value, one = graph.apply("add", self.arithmetic(known), 0.0), graph.constant(1.0)
                slopes = [tangent([value], {known[name]: one})[0] for name in self.start]
        except (ArithmeticError, ValueError, TypeError) as error:
            raise UserError(
                f"measurement.expression: a part that is made of numbers alone has no real value ({error})"
            ) from None
        return Program.of([value], list(known.values())), Program.of(slopes, list(known.values()))

    def _values(self, x: Array) -> list[Array]:
        p = dict(zip(self.start, (x * self.sizes).T[:, :, None], strict=True))
        return [p[name] if name in p else self.column(name)[None] for name in self.arithmetic.names]

    def remarks(self, x: Array) -> tuple[str, ...]:
        """Which conditionals never switch at x."""
        values = dict(zip(self.arithmetic.names, (value[0] for value in self._values(x[None, : self.n])), strict=True))
        found = comparisons({"expression": self.arithmetic})
        with np.errstate(all="ignore"):
            said = [never_switches(where, tree, Arithmetic("", tree, ())(values)) for where, tree in found]
        return tuple(sentence for one in said for sentence in one)

    def simulate(self, x: Array) -> Array:
        value, _ = self._recorded
        with np.errstate(all="ignore"):
            z = value(self._values(x))[0]
        return np.array(np.broadcast_to(z, (len(x), self.m)))

    def jacobian(self, x: Array) -> Array:
        _, slopes = self._recorded
        with np.errstate(all="ignore"):
            columns = slopes(self._values(x))
        J = np.empty((len(x), self.m, self.n))
        for i, column in enumerate(columns):
            J[:, :, i] = column * self.sizes[i]
        return J
