"""Differential equations that are described in a config, in the language of formulas: no plugin and no Python."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.arithmetic import Arithmetic, read, require_finite, require_parameters
from ipe_bench.measurements.base import Input, Measurement, Parameter
from ipe_bench.measurements.ode import sampling
from ipe_bench.measurements.ode.model import OdeMeasurement

_SHARE = 1e-8
"""Of the largest reading, what the integration may leave unless told otherwise."""
_TRIAL_STEPS = 16
"""Steps within the shortest interval that tell how large readings are."""
_COLUMNS = ("case", "time", "output", "reading", "sigma")
"""Columns that mean something else than a constant."""


@dataclass(frozen=True)
class Ode(Measurement):
    """Readings of the solution of differential equations, each a formula of the states, the parameters and t.

        states prey and predators with
        rates    prey: a*prey - b*prey*predators     predators: d*prey*predators - c*predators
        initial  prey: 34     predators: y0
        outputs  prey: prey
        start    a: 0.5  b: 0.03  c: 0.8  d: 0.02  y0: 6

    A parameter is a name with a start; it has no unit but that which the formulas give it, and its size is the
    magnitude of its start. `initial` may hold parameters and constants, but neither states nor t; a state that is
    absent there starts at 0.
    Every other name is a constant of a case, such as a dose, a temperature or an initial state: cases are experiments
    that share the parameters. A readings file has the columns time, reading, one for every such constant, with several
    cases `case` (1, 2, ...), and with several outputs `output`.
    """

    rates: Mapping[str, str]
    """The time derivative of every state."""
    start: Mapping[str, float] = field(default_factory=dict)
    """Where estimation begins, for each parameter: the nominal point."""
    initial: Mapping[str, str | float] = field(default_factory=dict)
    """The states at t = 0."""
    outputs: Mapping[str, str] = field(default_factory=dict)
    """What is read at each time; none: every state."""
    times: tuple[float, ...] = ()
    """When it is read; a readings file brings its own."""
    tolerance: Positive | None = None
    """The error that the integration may leave in a reading; None: 1e-8 of the largest reading at the start."""
    step: Positive | None = None
    """A longest integration step for all, in place of the tolerance."""
    unit: str = ""
    """Of the readings."""
    time_unit: str = ""
    own: tuple[str, ...] = ()
    """Parameters of which every file of readings has its own, where there are several."""
    constants: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    """What is known of each case: a number for each, or one for all; a readings file brings its own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rates:
            raise UserError("rates: is empty; give each state its rate, such as rates.y=-k*y")
        for name in self.initial:
            if name not in self.rates:
                raise UserError(f"initial.{name}: there is no such state; these have rates: {', '.join(self.rates)}")
        for name, value in self.start.items():
            require_finite(f"start.{name}", value)
            if name in self.rates or name == "t":
                raise UserError(f"start.{name}: is a state or the time, and not a parameter; rename one of them")
        for name, formula in self._initial.items():
            for used in formula.names:
                if used in self.rates or used == "t":
                    raise UserError(f"initial.{name}: {used} is a state or the time, which a start cannot depend on")
        used = {name for part in (self._rates, self._initial, self._outputs) for f in part.values() for name in f.names}
        for name in self.start:
            if name not in used:
                raise UserError(f"start.{name}: appears in no formula")
        if not self.start:
            raise UserError("start: is empty, so nothing is to be estimated; give each parameter a start")
        if any(time < 0 for time in self.times) or any(b <= a for a, b in itertools.pairwise(self.times)):
            raise UserError(f"times={list(self.times)}: give ascending numbers from 0 on")
        require_parameters("own", self.own, self.start)
        self._check_constants()

    def _check_constants(self) -> None:
        for name in self._constants:
            if name in _COLUMNS:
                remedy = "the time is t" if name == "time" else "rename it"
                raise UserError(f"{name}: is a column of every readings file, and not known in a formula; {remedy}")
        for name, values in self.constants.items():
            if name not in self._constants:
                known = "is a state, a parameter or the time" if name in self._named else "appears in no formula"
                raise UserError(f"constants.{name}: {known}")
            for value in values if isinstance(values, tuple | list) else [values]:
                require_finite(f"constants.{name}", value)
        lengths = {name: len(v) for name, v in self.constants.items() if isinstance(v, tuple | list)}
        if len(set(lengths.values())) > 1 or 0 in lengths.values():
            raise UserError(f"constants: have different lengths: {lengths}; give one number for each case")

    @property
    def _named(self) -> set[str]:
        """The names that mean something without a constant of that name."""
        return {*self.start, *self.rates, "t"}

    @cached_property
    def _constants(self) -> tuple[str, ...]:
        """The names that are constants of a case, in order of appearance."""
        formulas = [f for part in (self._rates, self._initial, self._outputs) for f in part.values()]
        return tuple(dict.fromkeys(name for f in formulas for name in f.names if name not in self._named))

    @cached_property
    def cases(self) -> Array:
        """The constants of each case (cases, constants)."""
        for name in self._constants:
            if name not in self.constants:
                raise UserError(
                    f"measurement: {name} is not known; give it a start, measurement.start.{name}=1, if it is a "
                    f"parameter, or its value in each case, as a column of readings=FILE or "
                    f"measurement.constants.{name}=[...]"
                )
        columns = [np.atleast_1d(self.constants[name]) for name in self._constants]
        count = max((len(column) for column in columns), default=1)
        return np.array([np.broadcast_to(column, count) for column in columns], dtype=float).reshape(-1, count).T

    @cached_property
    def _rates(self) -> dict[str, Arithmetic]:
        return {name: read(str(text), f"rates.{name}") for name, text in self.rates.items()}

    @cached_property
    def _initial(self) -> dict[str, Arithmetic]:
        return {name: read(str(self.initial.get(name, 0.0)), f"initial.{name}") for name in self.rates}

    @cached_property
    def _outputs(self) -> dict[str, Arithmetic]:
        shown = self.outputs or {name: name for name in self.rates}
        return {name: read(str(text), f"outputs.{name}") for name, text in shown.items()}

    @cached_property
    def engine(self) -> OdeMeasurement:
        """The equations as the integrator takes them."""
        if not self.times:
            raise UserError("measurement.times: is empty; give the times of the readings, or readings=FILE")
        _ = self.cases
        return _Engine(self)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, size=abs(float(value)) or 1.0) for name, value in self.start.items())

    @cached_property
    def nominal(self) -> Array:
        return np.sign([float(value) for value in self.start.values()])

    @property
    def reading_unit(self) -> str:  # type: ignore[override]
        return self.unit

    @property
    def own_parameters(self) -> tuple[str, ...]:
        return self.own

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return self.engine.index

    @property
    def epochs(self) -> tuple[NDArray[np.intp], ...] | None:
        return self.engine.epochs

    @property
    def inputs(self) -> tuple[Input, ...]:
        stated = {name: values for name, values in self.constants.items() if not isinstance(values, tuple | list)}
        constants = (Input(name, default=stated.get(name)) for name in self._constants)
        return *sampling.inputs(self.time_unit, tuple(self._outputs), 1), *constants

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        cases = np.asarray(self.index["case"]) - 1
        return {name: self.cases[cases, k].tolist() for k, name in enumerate(self._constants)}

    @property
    def input_columns_known(self) -> bool:
        return bool(self.times) and all(name in self.constants for name in self._constants)

    def absent_input(self, heading: str, columns: Sequence[str]) -> str:
        if heading not in self._constants:
            return super().absent_input(heading, columns)
        return (
            f"there are {', '.join(columns)}. If {heading} is a parameter, give it a start: "
            f"measurement.start.{heading}=VALUE; if it is the same in all cases, measurement.constants.{heading}=VALUE"
        )

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        del readings
        count = sampling.cases(columns["case"]) if self._constants else 1
        constants = {name: sampling.of_cases(name, columns[name], columns["case"], count) for name in self._constants}
        whole = replace(self, constants=constants)
        return sampling.sampled(columns, tuple(self._outputs), count, lambda times: replace(whole, times=times))

    def simulate(self, x: Array) -> Array:
        return self.engine.simulate(x)

    def hindrance(self, x: Array) -> str:
        return self.engine.hindrance(x)

    def jacobian(self, x: Array) -> Array:
        return self.engine.jacobian(x)

    def simulate_until(self, x: Array, stop: int) -> Array:
        return self.engine.simulate_until(x, stop)

    def jacobian_until(self, x: Array, stop: int) -> Array:
        return self.engine.jacobian_until(x, stop)


@dataclass(frozen=True)
class _Engine(OdeMeasurement):
    """The model that `Ode` describes, for the integrator."""

    described: Ode

    @property
    def states(self) -> int:  # type: ignore[override]
        return len(self.described.rates)

    @property
    def outputs(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(self.described._outputs)

    @property
    def time_unit(self) -> str:  # type: ignore[override]
        return self.described.time_unit

    @property
    def step(self) -> float | None:  # type: ignore[override]
        return self.described.step

    @cached_property
    def tolerance(self) -> float:  # type: ignore[override]
        if self.described.tolerance is not None:
            return self.described.tolerance
        intervals = np.diff(self.times, prepend=0.0)
        trial = replace(self.described, step=float(intervals[intervals > 0].min()) / _TRIAL_STEPS)
        largest = float(np.abs(trial.engine.simulate(self.nominal[None])).max())
        return _SHARE * largest if 0 < largest < np.inf else _SHARE

    @property
    def cases(self) -> Array:
        return self.described.cases

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.described.parameters

    @property
    def nominal(self) -> Array:
        return self.described.nominal

    @cached_property
    def times(self) -> Array:
        return np.asarray(self.described.times)

    def _known(self, p: Sequence[Any], c: Sequence[Any]) -> dict[str, Any]:
        return dict(zip(self.described.start, p, strict=True)) | dict(zip(self.described._constants, c, strict=True))

    def start(self, p, c):
        return [formula(self._known(p, c)) for formula in self.described._initial.values()]

    def rhs(self, t, y, p, c):
        values = {**self._known(p, c), **dict(zip(self.described.rates, y, strict=True)), "t": t}
        return [formula(values) for formula in self.described._rates.values()]

    def read(self, t, y, p, c):
        values = {**self._known(p, c), **dict(zip(self.described.rates, y, strict=True)), "t": t}
        return [formula(values) for formula in self.described._outputs.values()]
