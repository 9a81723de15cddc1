"""State models written in a config: transition, readings and noise as formulas of named states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive
from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.trace import Expression, Graph, Program, RowPrograms, dependent, slopes
from ipe_bench.measurements.arithmetic import Arithmetic, parse
from ipe_bench.measurements.base import Parameter, differentiate
from ipe_bench.states.along import Recording
from ipe_bench.states.base import Normal, Paths, StateModel


@dataclass(frozen=True, kw_only=True)
class Formulas(StateModel):
    """States whose next values, and readings, are formulas of the states, constants, the number k of the epoch from 1
    on, and its time t in s; the transition may contain the names of the process noise, each with a factor.

    The language is that of `ipe_bench.measurements.arithmetic`: + - * / ** and elementary functions, angles in rad.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.states.Formulas(
    ...     next={"x": "x + v", "v": "v + w"}, readings={"z": "x"},
    ...     noise={"w": 0.1}, deviation={"z": 1.0}, spread={"x": 5.0, "v": 1.0}, count=20,
    ... )
    >>> table = ib.run(model, {"ekf": ib.states.ekf()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    next: Mapping[str, str]
    """The next value of each state."""
    readings: Mapping[str, str]
    """Each reading."""
    noise: Mapping[str, NonNegative] = field(default_factory=dict)
    """Standard deviation of each independent process noise, by the name that it has in the transition."""
    deviation: Mapping[str, NonNegative | str]
    """Standard deviation of each reading: a number, or a formula as those of the readings are."""
    start: Mapping[str, Finite] = field(default_factory=dict)
    """Mean of each state in the prior; 0 where absent."""
    spread: Mapping[str, NonNegative]
    """Standard deviation of each state in the prior."""
    constants: Mapping[str, Finite] = field(default_factory=dict)
    """Numbers that the formulas name."""
    inputs: Mapping[str, Finite | tuple[Finite, ...]] = field(default_factory=dict)
    """Known inputs that the formulas name, such as a control: one number, or one for each epoch. `time` is the time of
    each epoch in s."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of states."""
    scored: tuple[str, ...] = ()
    """Names of the states by which trackers are scored, such as constants among states that move; empty: all."""
    period: Mapping[str, NonNegative] = field(default_factory=dict)
    """Periods of readings that come round, such as 6.283185307 of a bearing in rad."""
    state_period: Mapping[str, NonNegative] = field(default_factory=dict)
    """Periods of states that come round, such as 6.283185307 of a heading in rad."""
    count: Count = 100
    """K, the number of epochs."""
    step: Positive = 1.0
    """Seconds between epochs."""
    moved_first: bool = True
    """Whether the first reading is taken a step after the prior and time 0; if not, it is taken at time 0."""
    title: str = "formulas"
    """The name of the model in tables."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "name", self.title)
        names = [*self.next, *self.noise, *self.constants, *self.inputs, "k", "t"]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise UserError(
                f"next.{twice}: two of states, noise, constants, inputs, k and t have this name; rename one"
            )
        known = {*self.next, *self.constants, *self.inputs, "k", "t"}
        for key, formulas, names in (
            ("next", self._transitions, {*known, *self.noise}),
            ("readings", self._readings, known),
            ("deviation", self._deviations, known),
        ):
            if not formulas and key != "deviation":
                raise UserError(f"{key}: is empty; write state_model.{key}.NAME=FORMULA")
            for label, formula in formulas.items():
                for name in formula.names:
                    if name not in names:
                        raise UserError(f"{key}.{label}: {unknown(name, names, 'name')}")
        moved = {name for formula in self._transitions.values() for name in formula.names}
        if idle := next((name for name in self.noise if name not in moved), None):
            raise UserError(
                f"noise.{idle}: stands in no formula of next; add it to one, or leave it out"
            )
        owners = {
            "deviation": self.readings,
            "period": self.readings,
            "spread": self.next,
            "start": self.next,
        }
        owners["state_period"] = self.next
        for key, labels in owners.items():
            given = getattr(self, key)
            for label in given:
                if label not in labels:
                    raise UserError(f"{key}.{label}: {unknown(label, labels, 'name')}")
            if key in ("deviation", "spread") and (absent := set(labels) - set(given)):
                raise UserError(f"{key}.{min(absent)}: is not given; give it a value")
        for label, given in self.inputs.items():
            if (number := np.size(given)) not in (1, self.count):
                raise UserError(
                    f"inputs.{label}: has {number} numbers; give one, or one for each of {self.count} epochs"
                )
        known, factors = self._factors
        if found := next(
            (name for name in self.noise if dependent(factors, [known[name]]) & {*factors}), None
        ):
            raise UserError(
                f"next: depends on {found} by more than a factor; write FACTOR*{found} + ... of process noise"
            )

    @cached_property
    def _transitions(self) -> dict[str, Arithmetic]:
        return {name: parse(text, f"next.{name}") for name, text in self.next.items()}

    @cached_property
    def _readings(self) -> dict[str, Arithmetic]:
        return {name: parse(text, f"readings.{name}") for name, text in self.readings.items()}

    @cached_property
    def _deviations(self) -> dict[str, Arithmetic]:
        """The formulas of standard deviations, if any is one and no number."""
        if not any(isinstance(value, str) for value in self.deviation.values()):
            return {}
        return {
            name: parse(str(self.deviation[name]), f"deviation.{name}") for name in self.readings
        }

    @cached_property
    def _inputs(self) -> dict[str, Array]:
        """Each input (K,)."""
        return {
            name: np.broadcast_to(np.array(given, dtype=float), self.count)
            for name, given in self.inputs.items()
        }

    @property
    def reading_names(self) -> tuple[str, ...]:
        return tuple(self.readings)

    @property
    def times(self) -> Array:
        return self._times

    @cached_property
    def _times(self) -> Array:
        return self._inputs.get("time", self.step * (np.arange(self.count) + self.moved_first))

    @property
    def log_inputs(self) -> tuple[str, ...]:
        return tuple(self.inputs)

    def with_log(self, count: int, inputs: Mapping[str, Array]) -> Formulas:
        return replace(
            self,
            count=count,
            inputs={name: tuple(values.tolist()) for name, values in inputs.items()},
        )

    @property
    def states(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, self.units.get(name, "")) for name in self.next)

    @property
    def periods(self) -> tuple[float, ...]:
        return tuple(self.period.get(name, 0.0) for name in self.readings) if self.period else ()

    @property
    def state_periods(self) -> tuple[float, ...]:
        return (
            tuple(self.state_period.get(name, 0.0) for name in self.next)
            if self.state_period
            else ()
        )

    @property
    def prior(self) -> Normal:
        mean = np.array([self.start.get(name, 0.0) for name in self.next], dtype=float)
        return Normal(mean, np.diag([float(self.spread[name]) ** 2 for name in self.next]))

    def transition(self, x: Array, k: int) -> Array:
        return self._moved(x, np.zeros(len(self.noise)), k)

    def observe(self, x: Array, k: int) -> Array:
        return self._values(self._readings, x, k, {})

    def recorded(self, name: str, epochs: Sequence[int]) -> list[Recording]:
        """Records formulas once, with k, t, inputs and constants as numbers of the epoch, so that other values of these
        need no other machine code."""
        formulas = {"transition": self._transitions, "observe": self._readings}[name]
        columns = {**self._inputs, "k": np.arange(1.0, self.count + 1), "t": self._times}
        columns |= {name: np.full(self.count, value) for name, value in self.constants.items()}
        graph = Graph()
        known = {name: graph.input(name) for name in (*self.next, *columns)}
        still = dict.fromkeys(self.noise, graph.constant(0.0))
        y = [graph.apply("add", formula({**known, **still}), 0.0) for formula in formulas.values()]
        x, c = ([known[name] for name in names] for names in (self.next, columns))
        numbers = np.stack([*columns.values()], axis=1, dtype=float)
        places = np.array(epochs)
        return [Recording(RowFunction(RowPrograms.of(y, x, c)), places, numbers[places])]

    @cached_property
    def _factors(self) -> tuple[dict[str, Expression], list[Expression]]:
        """What the transitions name besides constants, and the factor of each noise in each state, as recordings."""
        graph = Graph()
        known = {
            name: graph.input(name) for name in (*self.next, *self.inputs, "k", "t", *self.noise)
        }
        moved = (
            graph.apply("add", formula({**self.constants, **known}), 0.0)
            for formula in self._transitions.values()
        )
        return known, [
            factor for one in moved for factor in slopes(one, [known[name] for name in self.noise])
        ]

    @property
    def gain_by_state(self) -> bool:
        return self._gain_by_state

    @cached_property
    def _gain_by_state(self) -> bool:
        known, factors = self._factors
        return bool(dependent(factors, [known[name] for name in self.next]) & {*factors})

    @cached_property
    def _program(self) -> Program:
        known, factors = self._factors
        return Program.of(factors, list(known.values())[: -len(self.noise)])

    def gain_at(self, x: Array, k: int) -> Array:
        if not self.gain_by_state:
            return self.gain(k)
        inputs = (float(values[k]) for values in self._inputs.values())
        with np.errstate(all="ignore"):
            G = self._program([*np.moveaxis(x, -1, 0), *inputs, k + 1.0, float(self._times[k])])
        G = np.stack(np.broadcast_arrays(x[..., 0], *G)[1:], axis=-1).reshape(
            *x.shape, len(self.noise)
        )
        return G * np.array([float(value) for value in self.noise.values()])

    def gain(self, k: int) -> Array:
        if self.gain_by_state:
            return super().gain(k)
        named = {name for formula in self._transitions.values() for name in formula.names}
        return self._gain(k) if named & {"k", "t", *self.inputs} else self._steady_gain

    @cached_property
    def _steady_gain(self) -> Array:
        return self._gain(0)

    def _gain(self, k: int) -> Array:
        """G (n, q) of the step into epoch k, which is that of all states."""
        if not self.noise:
            return np.zeros((self.n, 0))
        x = self.prior.mean
        factors = differentiate(
            lambda w: self._moved(x, w, k), np.zeros((1, len(self.noise))), analytic=True
        )[0]
        return factors * np.array([float(value) for value in self.noise.values()])

    @property
    def R_by_state(self) -> bool:
        return any(
            name in self.next for formula in self._deviations.values() for name in formula.names
        )

    def R_at(self, x: Array, k: int) -> Array:
        if not self.R_by_state:
            return self.R(k)
        return self._values(self._deviations, x, k, {})[..., None] ** 2 * np.eye(len(self.readings))

    def R(self, k: int) -> Array:
        if self.R_by_state:
            return super().R(k)
        if self._deviations:
            return np.diag(self._values(self._deviations, self.prior.mean, k, {}) ** 2)
        return np.diag([float(self.deviation[name]) ** 2 for name in self.readings])

    def _moved(self, x: Array, w: Array, k: int) -> Array:
        return self._values(
            self._transitions, x, k, dict(zip(self.noise, np.moveaxis(w, -1, 0), strict=True))
        )

    def _values(
        self, formulas: Mapping[str, Arithmetic], x: Array, k: int, noise: Mapping[str, Any]
    ) -> Array:
        """Those formulas (..., number) at states x (..., n) at epoch k."""
        known = dict(zip(self.next, np.moveaxis(x, -1, 0), strict=True)) | dict(noise)
        known |= {name: float(values[k]) for name, values in self._inputs.items()}
        known |= {**self.constants, "k": k + 1.0, "t": float(self._times[k])}
        with np.errstate(all="ignore"):
            values = np.broadcast_arrays(
                x[..., 0], *(formula(known) for formula in formulas.values())
            )[1:]
        return np.stack(np.broadcast_arrays(*values), axis=-1)


@dataclass(frozen=True, kw_only=True)
class RecordedFormulas(Formulas):
    """A model with one path and its readings that somebody has stored, and what is published of trackers on them.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum_book")
    >>> track = ib.estimate(model, estimators={"ekf": ib.states.ekf()})[0]
    >>> track.mean.shape
    (500, 2)
    """

    recorded: str
    """The CSV file of this package: time, states, readings."""
    published: Mapping[str, Mapping[str, float]]
    """By state and label of the tracker: root mean square error over all epochs."""
    source: str
    """Where path and figures come from."""

    def draw(self, start: int, stop: int, seed: int = 0) -> Paths:
        """The stored path; its state before the first epoch is not stored, and the first one stands for it."""
        if (start, stop) != (0, 1):
            raise UserError(f"state_model={self.name}: has one path; set trials=1")
        rows = np.loadtxt(
            Path(__file__).with_name(f"{self.recorded}.csv"), delimiter=",", skiprows=1
        )[None]
        x = np.ascontiguousarray(rows[..., 1 : 1 + self.n])
        return Paths(x[:, 0], x, np.ascontiguousarray(rows[..., 1 + self.n :]))
