"""Defines differential equations in a config, in the language of formulas: no plugin and no Python."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.files import own_conf
from ipe_bench.basics.linalg import Array, Covariance, own
from ipe_bench.basics.options import Count, Finite, Positive
from ipe_bench.measurements.arithmetic import COMPARISONS, Arithmetic, Tree, evaluate, never_switching, parse, parts
from ipe_bench.measurements.base import Input, Measurement, Parameter, Recorded, SubsetModel, UsualNoise, WrappedModel
from ipe_bench.measurements.formula import WrittenModel
from ipe_bench.measurements.ode import driven
from ipe_bench.measurements.ode.model import OdeMeasurement, time_heading
from ipe_bench.measurements.ode.rodas import SHAPE, Effort, Rodas5P

_SHARE = 1e-8
"""Default tolerance of the integration, as a share of the largest reading."""
_TRIAL_STEPS = 16
"""Steps within the shortest interval that tell how large readings are."""
_KINKED = 5.0
"""Tolerances by which readings may be off before it is told of; smooth rates leave less than one."""
_EASY = 16
"""Explicit steps between two readings up to which nominal equations are not asked whether they are stiff."""
_STIFF = 10.0
"""Explicit steps, for each implicit one, from which on equations are called stiff."""
_ASKED = 3000
"""Implicit steps times states and 4 that hold explicit readings against implicit ones, in a quarter of a second."""
_APART, _MISSED = 0.05, 1e3
"""Differences of explicit readings from a rough solution that need no accurate one, as a share of the largest reading
of an output; and from an accurate one, in tolerances."""
_IN_HAND = 0.3
"""Error of a step of the implicit method, as a share of the tolerance."""
_COLUMNS = ("case", "time", "output", "reading", "sigma")
"""Columns that mean something else than a constant."""


@dataclass(frozen=True)
class Ode(WrittenModel, WrappedModel):
    """Solves differential equations for readings, each a formula of the states, the parameters and t.

        states prey and predators with
        rates    prey: a*prey - b*prey*predators     predators: d*prey*predators - c*predators
        initial  prey: 34     predators: y0
        outputs  prey: prey
        start    a: 0.5  b: 0.03  c: 0.8  d: 0.02  y0: 6

    A parameter is a name with a start; unless told otherwise its size is the magnitude of its start. `initial` may hold
    parameters and constants, but neither states nor t; a state that is absent there starts at 0.
    Every other name is a constant of a case, such as a dose, a temperature or an initial state: cases are experiments
    that share the parameters. A readings file has the columns time, reading, one for every such constant, with several
    cases `case` (1, 2, ...), and with several outputs `output`.
    """

    rates: Mapping[str, str | float]
    """The time derivative of every state."""
    start: Mapping[str, Finite] = field(default_factory=dict)
    """Start of each parameter: the nominal point."""
    initial: Mapping[str, str | float] = field(default_factory=dict)
    """The states at t = 0."""
    outputs: Mapping[str, str | float] = field(default_factory=dict)
    """Formula of each output; none: every state is read."""
    times: tuple[float, ...] = ()
    """Times of the readings; a readings file brings its own."""
    tolerance: Positive | str | None = None
    """The error that the integration may leave in a reading, a number or a formula of t and the constants; None: 1e-8
    of the largest reading at the start."""
    step: Positive | None = None
    """A longest integration step for all, in place of the tolerance."""
    unit: str = ""
    """Unit of the readings."""
    time_unit: str = ""
    """Unit of the times: s, min, day."""
    own: tuple[str, ...] = ()
    """Parameters of which every file of readings has its own, where there are several."""
    constants: Mapping[str, Finite | tuple[Finite, ...]] = field(default_factory=dict)
    """Constants of each case: a number for each, or one for all; a readings file brings its own."""
    size: Mapping[str, Positive] = field(default_factory=dict)
    """Unit of error of a parameter; by default the magnitude of its start."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of the parameters."""
    readings: Count | None = None
    """Number of times at equal intervals, where `times` are not given."""
    interval: Positive = 1.0
    """Time between two of the `readings`."""
    deviation: Positive | None = None
    """The usual standard deviation of a reading."""
    answer: Mapping[str, Finite] = field(default_factory=dict)
    """Parameters whose readings are known exactly: with noise=certified they stand for the truth."""
    exact: Mapping[str, str | float] = field(default_factory=dict)
    """The readings at `answer`: for every output a formula of t, the parameters and the constants."""
    method: Literal["auto", "explicit", "implicit"] = "auto"
    """The integrator: explicit (DOP853), implicit (Rodas5P, for stiff equations), or as the equations ask for."""
    title: str = "ode"
    """The name of the model in tables."""
    driven_by: Mapping[str, Literal["hold", "linear"]] = field(default_factory=dict)
    """Inputs that change with time, by name: `hold` keeps a row's value from its time on, at its own reading too, until
    the next row of the case; `linear` is straight between rows. A row without a reading only changes them."""
    columns: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """The inputs of `driven_by`, where no file brings them: time, one column each, and `case` where cases differ."""
    reading: str = "reading"
    """Name of the readings' column in a file; `reading` is understood too."""
    circular: tuple[str, ...] = ()
    """Outputs that are angles, in rad, or in deg by their unit: their residuals are within half a turn."""

    index = WrappedModel.index

    @property
    def periods(self) -> Array | Sequence[float]:
        return self.whole.periods

    @property
    def name(self) -> str:
        return self.title

    @property
    def usual_noise(self) -> UsualNoise | None:
        return UsualNoise(self.deviation) if self.deviation else None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rates:
            raise UserError("rates: is empty; give each state its rate, such as rates.y=-k*y")
        if not self.start:
            raise UserError("start: is empty, so nothing is to be estimated; give each parameter a start")
        for name in self.initial:
            if name not in self.rates:
                raise UserError(f"initial.{name}: there is no such state; these have rates: {', '.join(self.rates)}")
        for name, formula in self.initial_formulas.items():
            if used := [used for used in formula.names if used in {*self.rates, *self.driven_by, "t"}]:
                raise UserError(f"initial.{name}: {used[0]} changes with time, and a start cannot depend on it")
        taken = {"start": (*self.rates, "t"), "driven_by": (*self.start, *self.rates, *_COLUMNS, self.reading, "t")}
        for key, others in taken.items():
            for name in getattr(self, key):
                if name in others:
                    raise UserError(f"{key}.{name}: the state, parameter, column or time has this name; choose another")
                if name not in self._used:
                    raise UserError(f"{key}.{name}: appears in no formula")
        if any(time < 0 for time in self.times) or any(b <= a for a, b in itertools.pairwise(self.times)):
            raise UserError(f"times={list(self.times)}: give ascending numbers from 0 on")
        if isinstance(self.tolerance, str):
            for name in parse(self.tolerance, "tolerance").names:
                if name != "t" and name not in self.constant_names:
                    raise UserError(f"tolerance: {name} is neither a constant nor t")
        for name in self.constant_names:
            if name in (*_COLUMNS, self.reading):
                remedy = "the time is t" if name == "time" else "rename it"
                raise UserError(f"{name}: is a column of every readings file, and not known in a formula; {remedy}")
        for name in self.constants:
            if name not in self.constant_names:
                known = "is a state, a parameter or the time" if name in self._used else "appears in no formula"
                raise UserError(f"constants.{name}: {known}")
        lengths = {name: len(v) for name, v in self.constants.items() if isinstance(v, tuple | list)}
        if len(set(lengths.values())) > 1 or 0 in lengths.values():
            raise UserError(f"constants: have different lengths: {lengths}; give one number for each case")
        for name in self.columns:
            if name not in ("case", "time", *self.driven_by):
                raise UserError(f"columns.{name}: {unknown(name, ['case', 'time', *self.driven_by], 'input')}")
        self.require_columns_and_parameters("size", "units", "answer", "own", readings=list(self.output_formulas))

    @cached_property
    def constant_names(self) -> tuple[str, ...]:
        """The names that are constants of a case, in order of appearance."""
        return tuple(name for name in self._used if name not in {*self.start, *self.rates, *self.driven_by, "t"})

    @cached_property
    def _used(self) -> tuple[str, ...]:
        """The names in all formulas, in order of appearance."""
        parts = (self.rate_formulas, self.initial_formulas, self.output_formulas)
        return tuple(dict.fromkeys(name for part in parts for formula in part.values() for name in formula.names))

    @cached_property
    def cases(self) -> Array:
        """The constants of each case (cases, constants)."""
        for name in self.constant_names:
            if name not in self.constants:
                remedy = f"give it a start, measurement.start.{name}=1, if it is a parameter, or its value in each case"
                places = f"as a column of readings=FILE or measurement.constants.{name}=[...]"
                raise UserError(f"measurement: {name} is not known; {remedy}, {places}")
        columns = [np.atleast_1d(self.constants[name]) for name in self.constant_names]
        count = max([len(self.courses), *map(len, columns)], default=1) or 1
        if any(len(column) not in (1, count) for column in [*columns, *([self.courses] if self.courses else [])]):
            raise UserError(f"columns.case: numbers {len(self.courses)} cases, and the constants have {count}")
        return np.array([np.broadcast_to(column, count) for column in columns], dtype=float).reshape(-1, count).T

    @cached_property
    def rate_formulas(self) -> dict[str, Arithmetic]:
        return _read_all("rates", self.rates)

    @cached_property
    def initial_formulas(self) -> dict[str, Arithmetic]:
        return _read_all("initial", {name: self.initial.get(name, 0.0) for name in self.rates})

    @cached_property
    def output_formulas(self) -> dict[str, Arithmetic]:
        return _read_all("outputs", self.outputs or {y: y for y in self.rates})

    @cached_property
    def courses(self) -> list[dict[str, Any]]:
        """The inputs of `driven_by` over time in each case; of one where all are alike."""
        return driven.courses(self.columns, self.driven_by) if self.driven_by else []

    @cached_property
    def piecewise_rates(self) -> tuple[dict[str, Arithmetic], dict[str, Tree]]:
        """The rates with a name in place of every comparison of t with constants, and these comparisons."""
        return driven.separated(self.rate_formulas, self.constant_names)

    @cached_property
    def engine(self) -> _Engine:
        """The equations as the integrator takes them, with readings wherever an input or a rate changes, too."""
        return _Engine(self)

    @cached_property
    def reading_times(self) -> Array:
        if not (self.times or self.readings):
            raise UserError("measurement.times: is empty; give the times of the readings, or readings=FILE")
        return np.asarray(self.times) if self.times else self.interval * np.arange(1.0, (self.readings or 0) + 1)

    @cached_property
    def whole(self) -> Measurement:
        engine, read = self.engine, np.searchsorted(self.engine.times, self.reading_times)
        if len(read) == len(engine.times):
            return engine
        rows = np.arange(engine.m).reshape(len(engine.cases), len(engine.times), -1)[:, read]
        return SubsetModel(engine, tuple(rows.ravel().tolist()))

    @property
    def inputs(self) -> tuple[Input, ...]:
        stated = {name: values for name, values in self.constants.items() if not isinstance(values, tuple | list)}
        outputs = tuple(self.output_formulas)
        return (
            Input("case", int, label=True, default=1),
            Input(time_heading(self.time_unit)),
            Input("output", str, label=True, default=outputs[0] if len(outputs) == 1 else None),
            *(Input(name, default=stated.get(name)) for name in self.constant_names),
            *map(Input, self.driven_by),
        )

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        cases = np.asarray(self.index["case"]) - 1
        found = {name: self.cases[cases, k].tolist() for k, name in enumerate(self.constant_names)}
        return found | {name: self._at_readings(name) for name in self.driven_by}

    def _at_readings(self, name: str) -> list[float]:
        """Returns the values (m,) of an input; refuses one that changes at other times, too."""
        if lost := {float(t) for one in self.courses for t in one["time"]} - set(map(float, self.reading_times)):
            remedy = "add it to measurement.times to write the readings with their inputs"
            raise UserError(f"measurement.columns.time: {name} changes at {min(lost):g} without a reading; {remedy}")
        engine = self.engine
        values = engine.at_times([0.0] * engine.states, [0.0] * self.n)[name]
        read = np.searchsorted(engine.times, self.reading_times)
        return np.repeat(values[:, read], len(engine.outputs), axis=1).ravel().tolist()

    @property
    def input_columns_known(self) -> bool:
        known = {*self.constants, *self.columns}
        return bool(self.times or self.readings) and known.issuperset((*self.constant_names, *self.driven_by))

    def remarks(self, x: Array) -> tuple[str, ...]:
        """Says that the implicit method is chosen, or is nearer, and which conditionals never switch along the solution
        at x."""
        found, engine = [], self.engine
        rates, outputs = self.rate_formulas.values(), self.output_formulas.values()
        if self.method == "auto" and engine.stiff:
            work = engine.shape[1]
            reason = (
                f"the equations are stiff: an explicit method would need {work.explicit:.1e} steps for stability where "
                f"the solution needs {work.steps}"
            )
            if work.explicit <= _STIFF * work.steps:
                reason = "the shortest steps of the explicit method are too long for these equations"
                if engine.missed:
                    reason = f"the explicit method misses what happens: it is {engine.missed:.1e} tolerances off"
            found.append(
                f"{reason}; they are integrated by the implicit method "
                "(measurement.method=explicit or implicit fixes it)"
            )
        operations = {part[0] for one in self.piecewise_rates[0].values() for part in parts(one.tree)}
        if not operations.isdisjoint(driven.PIECEWISE) and (off := engine.off(x)) > _KINKED:
            found.append(
                f"the explicit method leaves readings off by about {off:.0f} times the tolerance, as it does where "
                "rates have kinks, and slopes right to two or three digits; measurement.method=implicit brings the "
                "readings nearer, but not always the slopes"
            )
        if any(part[0] in COMPARISONS for one in (*rates, *outputs) for part in parts(one.tree)):
            known = engine.along(x)
            found += never_switching(rates, known | {"t": driven.middles(engine.times)[None, :-1]})
            found += never_switching(outputs, known)
        stepping = (*COMPARISONS, "floor", "sign", "mod")
        if not found and any(part[0] in stepping for one in (*rates, *outputs) for part in parts(one.tree)):
            found += self.flat(x)
        return tuple(found)

    def absent_input(self, heading: str, columns: Sequence[str]) -> str:
        if heading in self.driven_by:
            return f"measurement.driven_by.{heading} takes it from the file, in every row"
        if heading == time_heading(self.time_unit):
            return f"there are {', '.join(columns)}; call the times `{heading}`"
        if heading == "output" and self.outputs:
            return f"it says which of {', '.join(self.outputs)} a row reads"
        if heading == "output":
            named = "measurement.outputs.{0}={0}".format(*self.rates)
            return f"{len(self.rates)} states are read; name the one that is: {named}, or give the column"
        alike = f"if it is the same in all cases, measurement.constants.{heading}=VALUE"
        return f"{super().absent_input(heading, columns)}; {alike}"

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        heading, outputs = time_heading(self.time_unit), list(self.output_formulas)
        rows = list(zip(columns["case"], map(float, columns[heading]), columns["output"], strict=True))
        count = driven.numbered_cases(columns["case"]) if self.constant_names or self.driven_by else 1
        for case, time, output in rows:
            if output not in outputs:
                raise UserError(f"output={output}: {unknown(str(output), outputs, 'output')}")
            if not 1 <= case <= count:
                raise UserError(f"case={case}: there are {count} cases")
            if time < 0:
                raise UserError(f"{heading}={time}: comes before the start, which is at 0")
        remedy = "" if count > 1 else "; number the cases in a column case"
        in_cases = [(case,) for case, *_ in rows]
        constants = {n: tuple(driven.agreed(n, columns[n], in_cases, remedy).values()) for n in self.constant_names}
        changes = sorted({(case, time) for case, time, _ in rows})
        inputs = {n: list(driven.agreed(n, columns[n], [row[:2] for row in rows]).values()) for n in self.driven_by}
        if inputs:
            inputs |= {"case": [case for case, _ in changes], "time": [time for _, time in changes]}
        times = sorted({time for _, time, _ in rows})
        whole = replace(self, constants=constants, times=tuple(times), columns=inputs)
        place = {time: k for k, time in enumerate(times)}
        kept = [((case - 1) * len(times) + place[t]) * len(outputs) + outputs.index(o) for case, t, o in rows]
        return whole if kept == list(range(whole.m)) else SubsetModel(whole, tuple(kept))

    @property
    def recorded(self) -> Recorded | None:
        """The exact readings of the answer, where it has all parameters and outputs."""
        whole = set(self.answer) == set(self.start) and set(self.exact) == set(self.output_formulas)
        if not whole or self.deviation is None:
            return None
        formulas = _read_all("exact", {name: self.exact[name] for name in self.output_formulas}).values()
        known = self.known(self.reading_times)
        z = np.array([formula({**self.answer, **one}) for one in known for formula in formulas])
        x = np.array([self.answer[name] for name in self.start]) / self.sizes
        return Recorded(z, Covariance(np.full(self.m, self.deviation)), x)

    @cached_property
    def known_of_cases(self) -> list[dict[str, float]]:
        """The constants of each case, by name."""
        return [dict(zip(self.constant_names, case.tolist(), strict=True)) for case in self.cases]

    def known(self, times: Array) -> list[dict[str, float]]:
        """Returns the constants and t at each of these times of each case."""
        return [{**case, "t": t} for case in self.known_of_cases for t in times.tolist()]


def _read_all(key: str, texts: Mapping[str, str | float]) -> dict[str, Arithmetic]:
    return {name: parse(str(text), f"{key}.{name}") for name, text in texts.items()}


class _Engine(OdeMeasurement):
    """Implements the model that `Ode` describes, for the integrator."""

    stiff_remedy = "measurement.method=implicit follows them"

    def __init__(self, described: Ode) -> None:
        self.described = described
        self.states, self.outputs = len(described.rates), tuple(described.output_formulas)
        self.time_unit, self.step = described.time_unit, described.step

    @property
    def name(self) -> str:
        return self.described.title

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.described.parameters

    @property
    def nominal(self) -> Array:
        return self.described.nominal

    @property
    def cases(self) -> Array:
        return self.described.cases

    @property
    def _coarsens(self) -> bool:
        return self.step is None and not self.stiff

    @property
    def periods(self) -> Array | Sequence[float]:
        described = self.described
        turns = [described.turn if {name, described.reading} & {*described.circular} else 0.0 for name in self.outputs]
        return np.tile(turns, self.m // len(turns)) if described.circular else ()

    @cached_property
    def times(self) -> Array:
        described = self.described
        changes = [float(time) for one in described.courses for time in one["time"]]
        for comparison in described.piecewise_rates[1].values():
            changes += driven.switching_times(comparison, described.known_of_cases)
        return driven.grid(described.reading_times, changes)

    @cached_property
    def driven(self) -> Array | None:
        """The comparisons of t and the inputs, of each interval."""
        described, at, switches = self.described, driven.middles(self.times), self.described.piecewise_rates[1]
        if not (switches or described.driven_by):
            return None
        tables = []
        for k, case in enumerate(described.known_of_cases):
            columns = [evaluate(tree, {**case, "t": at}) for tree in switches.values()]
            for name, kind in described.driven_by.items():
                one = described.courses[min(k, len(described.courses) - 1)]
                columns += driven.course(kind, one["time"], one[name], at)
            tables.append(np.stack([np.broadcast_to(column, at.shape) for column in columns], axis=1))
        return np.stack(tables, axis=1)

    @cached_property
    def shape(self) -> tuple[Array, Effort]:
        """The nominal readings (1, m) by the implicit method, near enough to show their size, and what they took."""
        return Rodas5P(self.stepped, SHAPE).measured(own(self.nominal[None]))

    @cached_property
    def stiff(self) -> bool:
        """Whether every trial is integrated by the implicit method: if stability alone takes more than `_STIFF` times
        as many explicit steps along the nominal solution, or the shortest of them do not follow it."""
        if self.described.method != "auto":
            return self.described.method == "implicit"
        if self.step is not None:
            return False
        if self._rungs[self._nominal_place] <= _EASY:
            return self.missed > 0
        z, work = self.shape
        return bool(np.isfinite(z).all() and (work.explicit > _STIFF * work.steps or super().hindrance(self.nominal)))

    @cached_property
    def missed(self) -> float:
        """The largest difference of nominal readings by few explicit steps from those by the implicit method, in
        tolerances; 0 where the explicit ones are near, nearer than rough implicit ones, or those of the finest rung.
        Two rungs may agree though none of their steps met a short pulse."""
        x, here, every = own(self.nominal[None]), self._rungs[self._nominal_place], len(self.times)
        explicit, finest = np.empty((2, 1, self.m))
        most = int(_ASKED / (4 + self.states) / max(1.0, len(self.cases) * self.states**2 / 2000))
        rough = Rodas5P(self.stepped, SHAPE).simulate(x, every, most)
        self._simulate(x, np.arange(1), here * self._parts, self._zeros, explicit)
        with np.errstate(all="ignore"):
            outputs = np.abs(rough).reshape(-1, len(self.outputs))
            largest = np.tile(np.nanmax(outputs, axis=0, initial=0.0), self.m // len(self.outputs))
            if not (np.abs(explicit - self.near(rough, explicit)) > _APART * largest).any():
                return 0.0
            self._simulate(x, np.arange(1), self._rungs[-1] * self._parts, self._zeros, finest)
            if (np.abs(explicit - self.near(finest, explicit)) <= _MISSED * self._tolerances).all():
                return 0.0
            accurate = self._implicit.simulate(x, every)
            apart = (np.abs(z - self.near(accurate, z)) for z in (explicit, rough))
            off, rough_off = (float(np.nanmax(one / self._tolerances, initial=0.0)) for one in apart)
        return off if off > max(_MISSED, rough_off) else 0.0

    def off(self, x: Array) -> float:
        """Computes by how many tolerances the explicit method differs from the implicit one in a reading at x (n,); 0
        where few explicit steps do."""
        x = own(x[None, : self.n])
        if self.stiff or self.step is not None or self._rungs[self._rungs_of(x, self._zeros).places[0]] <= _EASY:
            return 0.0
        z, accurate = self.simulate(x), self._implicit.simulate(x, len(self.times))
        difference = np.abs(z - self.near(accurate, z))
        return float(np.nan_to_num(difference / self._tolerances, nan=0.0, posinf=0.0).max())

    def along(self, x: Array) -> dict[str, Any]:
        """Evaluates the names in the formulas at x (n,), at the times of each case: (cases, times)."""
        shown = {y: y for y in self.described.rates}
        shown |= {f"output {k}": formula for k, formula in enumerate(self.described.outputs.values())}
        engine = replace(self.described, outputs=shown, circular=(), exact={}, answer={}).engine
        y = engine.simulate(x[None]).reshape(len(self.cases), len(self.times), -1)[:, :, : self.states]
        return self.at_times(list(np.moveaxis(y, 2, 0)), list(x[: self.n] * self.si_sizes))

    def at_times(self, y: Sequence[Any], p: Sequence[float]) -> dict[str, Any]:
        """Evaluates the names at states y, each (cases, times)."""
        c = self.tables[1:] if len(self.tables) > 1 else self.tables
        return self._values(self.times[None], y, p, list(np.moveaxis(c, (2, 1), (0, 1))))

    @cached_property
    def _implicit(self) -> Rodas5P:
        largest = float(np.nanmax(np.abs(self.shape[0]), initial=0.0)) or 1.0
        return Rodas5P(self.stepped, float(np.clip(_IN_HAND * np.min(self._tolerances) / largest, 1e-10, 1e-4)))

    def _shown(self, x: Array, stop: int, offset: Array, *, guess: bool = False) -> Array:
        return self._implicit.simulate(x, stop) if self.stiff else super()._shown(x, stop, offset, guess=guess)

    def jacobian_until(self, x: Array, stop: int) -> Array:
        return self._implicit.jacobian(x, stop) if self.stiff else super().jacobian_until(x, stop)

    @cached_property
    def jacobian_cost(self) -> float:
        return float(1 + self.n) if self.stiff else super().jacobian_cost

    def hindrance(self, x: Array) -> str:
        followed = self.stiff and np.isfinite(self.simulate(own(x[None, : self.n]))).all()
        return "" if followed else super().hindrance(x)

    @cached_property
    def tolerance(self) -> float:
        if isinstance(self.described.tolerance, float):
            return self.described.tolerance
        intervals = np.diff(self.times, prepend=0.0)
        # Readings at the start alone take no step.
        step = float(min(intervals[intervals > 0], default=1.0)) / _TRIAL_STEPS
        nominal = own(self.nominal[None])
        trials = [replace(self.described, step=h, method="explicit").simulate(nominal) for h in (step, step / 2)]
        first, largest = (float(np.abs(z).max()) for z in trials)
        if not 0.9 * largest <= first <= 1.1 * largest:  # explicit steps are unstable
            largest = float(np.abs(self.shape[0]).max())
        return _SHARE * largest if 0 < largest < np.inf else _SHARE

    @cached_property
    def _tolerances(self) -> Array:
        if not isinstance(self.described.tolerance, str):
            return super()._tolerances
        formula = parse(self.described.tolerance, "tolerance")
        return np.repeat([float(formula(known)) for known in self.described.known(self.times)], len(self.outputs))

    def _values(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> dict[str, Any]:
        """Evaluates the names in the formulas."""
        described = self.described
        values, constants = dict(zip((*described.rates, *described.start), (*y, *p), strict=True)) | {"t": t}, iter(c)
        for name in (*described.constant_names, *described.piecewise_rates[1]):
            values[name] = next(constants)
        for name, kind in described.driven_by.items():
            u = next(constants)
            values[name] = u if kind == "hold" else u + next(constants) * (t - next(constants))
        return values

    def _computed(self, formulas: Mapping[str, Arithmetic], t: Any, y: Any, p: Any, c: Any) -> list[Any]:
        values = self._values(t, y, p, c)
        return [formula(values) for formula in formulas.values()]

    def start(self, p, c):
        return self._computed(self.described.initial_formulas, 0.0, [0.0] * self.states, p, c)

    def rhs(self, t, y, p, c):
        return self._computed(self.described.piecewise_rates[0], t, y, p, c)

    def read(self, t, y, p, c):
        return self._computed(self.described.output_formulas, t, y, p, c)


def packaged(name: str, conf: Path | None = None) -> Callable[..., Ode]:
    """Returns the maker of the model that `measurement/NAME.yaml` in a folder `conf` describes, ours by default.

    It takes other options of `Ode`, and entries of `constants` and `start` by their own names: `Sir(population=500)`.
    """

    def model(**options: Any) -> Ode:
        config = dict(_description(name, conf or own_conf()))
        for key in ("constants", "start"):
            config[key] = {entry: options.pop(entry, value) for entry, value in config[key].items()}
        return Ode(**(config | options))

    model.__name__ = model.__qualname__ = "".join(part.title() for part in name.split("_"))
    return model


@functools.cache
def _description(name: str, conf: Path) -> dict[str, Any]:
    import yaml

    config = yaml.safe_load((conf / "measurement" / f"{name}.yaml").read_text(encoding="utf-8"))
    return {key: value for key, value in config.items() if key != "_target_"}
