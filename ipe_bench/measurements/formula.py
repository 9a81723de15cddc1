"""Defines measurement models that users write out: names with a start are parameters, others are
columns of a file."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, did_you_mean, refuse_unknown, shortened
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite
from ipe_bench.engine.trace import Graph, Program, slopes
from ipe_bench.measurements.arithmetic import Arithmetic, never_switching, parse
from ipe_bench.measurements.base import Input, Measurement, Parameter

_FARTHER = (0.3, -0.3, 1.0, -1.0)
"""Changes of a parameter without a slope, in multiples of its magnitude, at which readings are
looked at again."""
_FARTHER_BY = 1e-12
"""Change of readings that rounding may cause, as a share of the largest reading."""

_FAR = 100.0
"""Multiple of its spread beyond which a column is far from 0."""


class WrittenModel(Measurement):
    """Defines a model whose parameters are names with a start; `start`, `columns` and `unit` are
    options of each.

    The size of a parameter is the magnitude of its start, or 1 where that is 0, unless `size` says
    otherwise.
    """

    start: Mapping[str, float]
    columns: Mapping[str, Sequence[float]]
    unit: str
    size: Mapping[str, float] = {}
    units: Mapping[str, str] = {}

    headings: tuple[str, ...]
    """The names of the columns that it takes from the readings."""
    reading: str
    circular: tuple[str, ...] = ()
    outputs: Collection[str] = ()

    own: tuple[str, ...] = ()

    @property
    def reading_unit(self) -> str:
        return "" if self._other_angles else self.unit

    def unit_of(self, output: str) -> str:
        return "" if self._other_angles and output not in self.circular else self.unit

    @property
    def _other_angles(self) -> bool:
        """Whether some outputs are angles, so that the unit is theirs alone."""
        angles = {*self.circular}
        return bool(angles) and self.reading not in angles and not angles >= {*self.outputs}

    @property
    def reading_name(self) -> str:
        return self.reading

    @property
    def own_parameters(self) -> tuple[str, ...]:
        return self.own

    @cached_property
    def starts(self) -> dict[str, float]:
        """The parameters with their starts, in the order of x."""
        return {name: float(value) for name, value in self.start.items()}

    @property
    def parameter_units(self) -> Mapping[str, str]:
        return self.units

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        units = self.parameter_units
        found = []
        for name, start in self.starts.items():
            size = self.size.get(name, abs(start) or 1.0)
            found.append(Parameter(name, units.get(name, ""), float(size)))
        return tuple(found)

    @cached_property
    def nominal(self) -> Array:
        return np.array(list(self.starts.values())) / self.sizes

    @property
    def inputs(self) -> tuple[Input, ...]:
        return tuple(map(Input, self.headings))

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        return {name: self.column(name).tolist() for name in self.headings}

    @property
    def periods(self) -> Array | Sequence[float]:
        return np.full(self.m, self.turn) if self.circular else ()

    @property
    def turn(self) -> float:
        """A whole turn in the unit of the readings."""
        return {"deg": 360.0, "°": 360.0}.get(self.unit, 2 * np.pi)

    def column(self, name: str) -> Array:
        if name not in self.columns:
            raise UserError(
                f"measurement: {name} is neither a column nor a parameter; give a parameter its"
                f" start, measurement.start.{name}=VALUE, or the column,"
                f" measurement.columns.{name}=[...]; `ipe-bench estimate` takes it from"
                " readings=FILE"
            )
        column = self.columns[name]
        try:
            numbers = np.asarray(column, dtype=float)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        if numbers.ndim != 1 or not numbers.size:
            text = shortened(str(column), 60)
            raise UserError(f"measurement.columns.{name}={text}: give numbers, such as [1,2,3]")
        return numbers

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"row": list(range(1, self.m + 1)), **self.input_columns}

    def absent_input(self, heading: str, columns: Sequence[str]) -> str:
        remedy = f"If {heading} is a parameter, give it a start: measurement.start.{heading}=VALUE"
        return f"there are {', '.join(columns)}{did_you_mean(heading, columns) or '.'} {remedy}"

    def flat(self, x: Array) -> tuple[str, ...]:
        """Tells if readings are constant in pieces at x (n,): some parameters have no slope there,
        yet change readings."""
        x = x[None, : self.n]
        z = self.simulate(x)
        still = (self.jacobian(x)[0] == 0.0).all(axis=0)
        least = _FARTHER_BY * np.abs(z).max(initial=0.0)
        names = []
        for i in np.flatnonzero(still):
            steps = np.outer(_FARTHER, np.eye(self.n)[i]) * np.maximum(1.0, np.abs(x))
            with contextlib.suppress(UserError):  # where a function cannot be called
                moved = np.nan_to_num(np.abs(self.simulate(x + steps) - z))
                if (moved > least).any():
                    names.append(self.parameters[i].name)
        if not names:
            return ()
        far = self._far_columns()
        if far:
            return (
                f"readings do not change with {', '.join(names)} at the start; {far}, so that"
                " starts fit it",
            )
        return (
            f"readings do not change with small changes of {', '.join(names)}, but with larger"
            " ones: they are constant in pieces, as by floor, round, sign or a comparison, where"
            " every slope is 0, and no estimator that follows slopes moves from there; blend the"
            " pieces, as by tanh",
        )

    def _far_columns(self) -> str:
        """Says which columns are far from 0 beside their spread, and what to subtract from each."""
        found = []
        for name, values in self.input_columns.items():
            column = np.asarray(values)
            if column.dtype.kind not in "if":  # names of outputs
                continue
            spread = np.ptp(column)
            if 0.0 < _FAR * spread < np.abs(column).min():
                unit = 10.0 ** np.ceil(np.log10(spread))
                origin = np.floor(column.min() / unit) * unit
                found.append(f"{name} is far from 0: subtract {origin:.15g} from it")
        return ", ".join(found)

    def require_columns_and_parameters(self, *keys: str, readings: Sequence[str] = ()) -> None:
        """Refuses columns of different lengths, names in the options `keys` that are no parameters,
        and angles that are none of the `readings` or have another unit."""
        known = readings or [self.reading]
        for name in self.circular:
            refuse_unknown(f"circular={name}", name, known, "reading")
            if self.unit not in ("", "rad", "deg", "°"):
                raise UserError(
                    f"unit={self.unit}: circular={name} is an angle, in rad or deg; give one of"
                    " these"
                )
        lengths = {name: len(column) for name, column in self.columns.items()}
        if len(set(lengths.values())) > 1:
            raise UserError(f"columns: have different lengths: {lengths}")
        for key in keys:
            for name in getattr(self, key):
                if name not in self.starts:
                    meant = did_you_mean(name, self.starts)
                    these = ", ".join(self.starts)
                    raise UserError(f"{key}: {name} is not a parameter{meant} (these are {these})")


@dataclass(frozen=True)
class Formula(WrittenModel):
    """Computes z = expression, in which names with a start are parameters and all others columns of
    the readings.

        ipe-bench estimate measurement=formula "measurement.expression=b1*(1-exp(-b2*t))" \\
            measurement.start.b1=500 measurement.start.b2=1e-4 readings=my.csv

    The language is that of `ipe_bench.measurements.arithmetic`: + - * / ** and elementary
    functions, angles in rad. Parameters stand in the order of their starts, each in multiples of
    its magnitude; they have no units but those that the formula gives them. Readings have the order
    of the file, and no epochs.

    Example:

    >>> import ipe_bench as ib
    >>> start = {"b1": 20.0, "b2": 0.5}
    >>> model = ib.measurements.Formula("b1*(1-exp(-b2*t))", start, columns={"t": [1, 2, 4]})
    >>> print(model.simulate(model.nominal[None]).round(2))
    [[ 7.87 12.64 17.29]]
"""

    expression: str
    """The formula of a reading, such as b1*(1-exp(-b2*t))."""
    start: Mapping[str, Finite] = field(default_factory=dict)
    """Start of each parameter."""
    columns: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Columns of the readings for `run`, which has no file."""
    readings: Count | None = None
    """Number of readings; None: the length of the columns."""
    reading: str = "y"
    """Name of the readings' column in a file; `reading` is understood too."""
    unit: str = ""
    """Unit of the readings."""
    own: tuple[str, ...] = ()
    """Parameters of which every file of readings has its own, where there are several."""
    circular: tuple[str, ...] = ()
    """The readings' name if they are angles, in rad, or in deg by their unit: residuals are within
    half a turn."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.start:
            if name not in self.arithmetic.names:
                wanted = ", ".join(self.arithmetic.names)
                raise UserError(
                    f"start.{name}: does not appear in the expression, whose names are {wanted}"
                )
        if not self.start:
            start = f"measurement.start.{next(iter(self.arithmetic.names), 'NAME')}=1"
            raise UserError(
                "start: is empty, so no parameter is estimated; give each parameter a start:"
                f" {start}"
            )
        if self.reading in self.arithmetic.names:
            raise UserError(
                f"reading={self.reading}: is also in the expression; what is measured cannot"
                " explain it"
            )
        self.require_columns_and_parameters("own")

    @cached_property
    def arithmetic(self) -> Arithmetic:
        return parse(self.expression, "expression")

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
                value = graph.apply("add", self.arithmetic(known), 0.0)
                by_parameter = slopes(value, map(known.__getitem__, self.start))
        except (ArithmeticError, ValueError, TypeError) as error:
            numbers = "a part of only numbers has no real value"
            raise UserError(f"measurement.expression: {numbers} ({error})") from None
        inputs = list(known.values())
        return Program.of([value], inputs), Program.of(by_parameter, inputs)

    @cached_property
    def linear(self) -> bool:
        program = self._recorded[0]
        moves = [name in self.start for name in self.arithmetic.names]
        for name, *numbers in program.operations:
            moved = [name != "constant" and moves[i] for i in numbers]
            if any(moved) and not _keeps_linear(name, *moved):
                return False
            moves.append(any(moved))
        return True

    def _values(self, x: Array) -> list[Array]:
        """Returns the values of the names: of parameters (trials, 1), of columns (1, m)."""
        p = dict(zip(self.start, (x * self.sizes).T[:, :, None], strict=True))
        return [p[name] if name in p else self._rows[name] for name in self.arithmetic.names]

    @cached_property
    def _rows(self) -> dict[str, Array]:
        """The columns (1, m) by name.

        To make a row of a list again at each call took 20 of the 64 s of CPU of `estimate
        "y = a + b*x" FILE` with a million rows.
        """
        return {name: self.column(name)[None] for name in self.headings}

    def remarks(self, x: Array) -> tuple[str, ...]:
        """Says which conditionals never switch at x, or else which parameters have no slope
        there."""
        at_x = [value[0] for value in self._values(x[None, : self.n])]
        values = dict(zip(self.arithmetic.names, at_x, strict=True))
        with np.errstate(all="ignore"):
            return tuple(never_switching([self.arithmetic], values)) or self.flat(x)

    def simulate(self, x: Array) -> Array:
        with np.errstate(all="ignore"):
            (z,) = self._recorded[0](self._values(x))
        return np.array(np.broadcast_to(z, (len(x), self.m)))

    @property
    def jacobian_cost(self) -> float:
        """The derivative along each parameter, by the rules of differentiation, counts as a
        simulation."""
        return float(self.n)

    def jacobian(self, x: Array) -> Array:
        with np.errstate(all="ignore"):
            columns = self._recorded[1](self._values(x))
        J = np.empty((len(x), self.m, self.n))
        for i, column in enumerate(columns):
            J[:, :, i] = column * self.sizes[i]
        lost = np.flatnonzero(np.isnan(J).any(axis=(1, 2)))
        if len(lost):
            # By the rules the slope of 1 / (1 + exp(800)) is infinity over infinity.
            lost = lost[np.isfinite(self.simulate(x[lost])).all(axis=1)]
            slopes = self._own_differences.differences(x[lost])
            J[lost] = np.where(np.isnan(J[lost]), slopes, J[lost])
        return J


def _keeps_linear(operation: str, *moved: bool) -> bool:
    """Tells whether an operation on linear functions of parameters is one, from which of its
    operands move with them."""
    if operation in ("mul", "fma", "fms", "fnma"):
        return not (moved[0] and moved[1])
    if operation == "div":
        return not moved[1]
    if operation == "where":
        return not moved[0]
    return operation in ("add", "sub", "neg")
