"""Measurement models whose readings are taken from the solution of ordinary differential
equations."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Mask, finite, own
from ipe_bench.engine import coarseness, ladder, watch
from ipe_bench.engine.equations import Equations, Recording, Variation
from ipe_bench.engine.integrator import Kernel, compiled_rates
from ipe_bench.engine.jumps import jumps
from ipe_bench.engine.rodas import MOST_STEPS, SHAPE, STABLE, Effort, Rodas5P, Stepped
from ipe_bench.engine.tableaus import DOP853, RK4
from ipe_bench.engine.trace import Graph, Program
from ipe_bench.measurements.base import Measurement, with_unit

_IN_HAND = 0.3
"""Error of a step of the implicit method, as a share of the tolerance."""
_ROUGHER = 10.0
"""Tolerances of the implicit method whose readings are held against each other, the larger over the
smaller."""
_MAGNIFIED = 300.0
"""Tolerances of a reading that a change of the states by the least tolerance, as a share of each,
may make."""
_ANGLE_AT_START = 0.7
"""Radians over which the first step that is tried lets the solution turn."""
_REMEMBERED = 100_000
"""Trials whose rungs are remembered: a simulation and a Jacobian share one search, and what is
forgotten is found again, the same."""


class OdeMeasurement(Measurement):
    """Takes readings of y' = rhs(t, y, p, c) at given times, for one or more cases that share the
    parameters.

    Required: `states`, `outputs`, `tolerance` or `step`, `parameters`, `times`, and the functions
    `start`, `rhs` and `read`. p are the parameters in SI units (x times `si_sizes`), c the
    constants of a case. Optional: `cases`, `driven` and `si_sizes`; `fastest_rate`, which saves a
    search; what a `Measurement` may state. Promised: the functions use arithmetic, NumPy's
    elementary functions and np.where on the entries of their arguments, and nothing that asks for a
    value (no if). z has C order over (case, time, output); a time is an epoch.

    >>> from dataclasses import dataclass
    >>> from ipe_bench.measurements import Parameter
    >>> @dataclass(frozen=True)
    ... class Pendulum(OdeMeasurement):  # released from half a radian
    ...     states, outputs, reading_unit = 2, ("angle",), "rad"
    ...     tolerance = 1e-9  # of a reading, in the reading's unit
    ...     # x counts in these sizes:
    ...     parameters = Parameter("length", "m", 0.01), Parameter("damping", "1/s", 0.01)
    ...     nominal = np.array([100.0, 0.0])  # about 1 m and no damping
    ...     times = np.arange(0.5, 10.5, 0.5)
    ...     def start(self, p, c):
    ...         return 0.5, 0.0
    ...     def rhs(self, t, y, p, c):
    ...         angle, rate = y
    ...         return rate, -9.80665 / p[0] * np.sin(angle) - p[1] * rate
    ...     def read(self, t, y, p, c):
    ...         return (y[0],)
    >>> # After 2 s; the period is 2.038 s.
    >>> print(Pendulum().simulate(np.array([[100.0, 0.0]]))[0, 3].round(3))
    0.497
    """

    states: int
    """Number of state variables."""
    outputs: tuple[str, ...]
    """The names of what is read at each time."""
    time_unit: str = "s"
    """The unit of `times`, `step` and t."""
    tolerance: float | Sequence[float] | None = None
    """The error that the integration may leave in a reading, in `reading_unit`; or one such error
    for each output. Each trial's step follows from it and from the trial's parameters."""
    step: float | None = None
    """A longest step for all trials, in place of `tolerance`; each interval between readings is
    divided evenly."""
    shortest_step: float = 0.0
    """Shortest step, but for 1/1024 of the usual interval between readings, for any parameters: it
    limits the cost of an iterate that diverges."""
    stiff_remedy: str = "put what decays fast in balance with the rest"
    """Remedy for equations that are stiff."""
    trusted_angle: float = 0.0
    """A step that is at most this over `fastest_rate` is known to hold the tolerance; 0: every
    trial is tested."""

    @property
    @abstractmethod
    def times(self) -> Array:
        """The times of the readings (times,) after the start at 0, in `time_unit`, ascending."""

    @property
    def cases(self) -> Array:
        """The constants of each case: (cases, constants). One case without constants unless
        overridden."""
        return np.zeros((1, 0))

    driven: Array | None = None
    """Constants that change with time (times + 1, cases, further constants), behind those of the
    cases: entry k holds from times[k - 1] on, at that reading too, until times[k]."""

    @cached_property
    def tables(self) -> Array:
        """All constants (intervals, cases, constants); a single interval where none changes."""
        cases = own(self.cases)[None]
        if self.driven is None:
            return cases
        fixed = np.repeat(cases, len(self.driven), axis=0)
        return own(np.concatenate([fixed, self.driven], axis=2))

    @property
    def si_sizes(self) -> Array:
        """The size (n,) of one unit of x in SI units."""
        return self.sizes

    @abstractmethod
    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """Returns the state at time 0."""

    @abstractmethod
    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """Returns the time derivative of the state."""

    @abstractmethod
    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """Returns the output of the instruments at the state, one entry per output."""

    variation: Variation | None = None
    """Equations of small deviations in fewer numbers than the state has, where the model knows
    them."""
    fastest_rate: Callable[[Sequence[Any]], Any] | None = None
    """A method fastest_rate(p), recorded like `rhs`: how fast the solution may turn, grow or decay,
    per unit of time. It says with which step the search begins; where there is none, it begins with
    that of the nominal parameters."""

    by_differential_equations = True

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        shape = len(self.cases), len(self.times), len(self.outputs)
        case, time, output = (places.ravel() for places in np.indices(shape))
        return {
            "case": (case + 1).tolist(),
            with_unit("time", self.time_unit): self.times[time].tolist(),
            "output": [self.outputs[i] for i in output],
        }

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        """One epoch per time, with the readings of all cases and outputs."""
        times = len(self.times)
        rows = np.arange(self.m).reshape(len(self.cases), times, len(self.outputs))
        return tuple(np.ascontiguousarray(rows[:, k]).ravel() for k in range(times))

    def simulate(self, x: Array) -> Array:
        return self.simulate_until(x, len(self.times))

    def simulate_until(self, x: Array, stop: int) -> Array:
        return self._shown(x, stop, self._origin)

    def coarse_simulate_until(self, x: Array, stop: int) -> Array:
        """Computes `simulate_until` without the search for the rung, if a rate says it well: GINS
        at an error scale of 2,000 is off by 1e-4 m/s at most in 100 trials, at 30,000 by 4e-7 in
        the median and 7e-3 in the worst."""
        return self._shown(x, stop, self._origin, guess=True)

    @property
    def _origin(self) -> Array:
        """Offset that readings (m,) are counted from."""
        return self._zeros

    def _shown(self, x: Array, stop: int, offset: Array, *, guess: bool = False) -> Array:
        """Subtracts the offset (m,) from readings."""
        x = own(x)
        cases = self.tables.shape[1]
        outputs = len(self.outputs)
        rows = np.arange(len(x))
        z = np.empty((len(x), cases * stop * outputs))
        if self._trusted(x).all():
            self._simulate(x, rows, self._parts, offset, z)
            return z
        found = self._rungs_of(x, offset, guess=guess)
        # Trials whose rung was searched for have their readings from the search.
        if len(found.computed):
            readings = found.z.reshape(-1, cases, len(self.times), outputs)[:, :, :stop]
            z[found.computed] = readings.reshape(len(readings), -1)
            rows = np.delete(rows, found.computed)
        for place, group in ladder.by_rung(found.places[rows], rows):
            self._simulate(x, group, self._rungs[place] * self._parts, offset, z)
        z[found.lost] = np.nan
        return z

    def hindrance(self, x: Array) -> str:
        x = own(x[None, : self.n])
        if np.isfinite(self.simulate(x)).all():
            return ""
        shortest = self.step or self._usual_interval / self._rungs[-1]
        return self._diagnosis(x, float(shortest))

    def _diagnosis(self, x: Array, shortest: float) -> str:
        """Says what hinders the integrator at x (1, n), whose shortest step is `shortest`."""
        unit = f" {self.time_unit}".rstrip()
        z, effort = Rodas5P(self.stepped, SHAPE).measured(x)
        if not np.isfinite(z).all():
            if effort.steps >= MOST_STEPS:
                return (
                    f"the solution takes more than {MOST_STEPS} steps, by the implicit method, too"
                )
            return f"the solution itself leaves all numbers near t = {effort.reached:.4g}{unit}"
        if self.step is None and not np.isfinite(self._told(x, len(self.times))).all():
            return (
                f"neither steps of {shortest:.2g}{unit}, the shortest, nor the implicit method"
                " determine these readings: outputs magnify what any step leaves of the states, or"
                " the solution parts from those next to it"
            )
        needed = STABLE / max(effort.fastest, 1e-300)
        if needed >= shortest:
            return f"steps of {shortest:.2g}{unit}, the shortest, are too long for these equations"
        looks = f"; they look stiff: {self.stiff_remedy}" if effort.explicit > effort.steps else ""
        place = f"at t = {effort.met:.4g}, and the shortest is {shortest:.2g}"
        return f"the equations need steps of {needed:.2g}{unit} {place}{looks}"

    @property
    def stepped(self) -> Stepped:
        """The equations with their numbers, as the implicit method takes them."""
        times = np.asarray(self.times, dtype=float)
        return Stepped(self.equations, self.tables, times, self.si_sizes)

    def _simulate(
        self,
        x: Array,
        rows: ladder.Indices,
        steps: NDArray[np.int64],
        offset: Array,
        z: Array,
        y: Array | None = None,
    ) -> None:
        """Fills these rows of z (trials, readings), as many times as it has room for, with so many
        steps to each, and of y (trials, cases, states, times + 1), if it has room for any."""
        at_each_time = self.tables.shape[1] * len(self.outputs)
        times = self._times[: z.shape[1] // at_each_time]
        if not self._kept[1]:
            y = None
        self._readings_kernel.run(
            x, self._si_sizes, self.tables, rows, times, steps, offset, z.reshape(-1), states=y
        )

    @cached_property
    def _zeros(self) -> Array:
        return np.zeros(self.m)

    @cached_property
    def _si_sizes(self) -> Array:
        return own(self.si_sizes)

    @cached_property
    def _times(self) -> Array:
        return own(self.times)

    @property
    def _kept(self) -> tuple[int, int, int]:
        """Cases, states and times that are held against each other, with a row behind the states
        that tells whether a step was in doubt. A stated rate needs none: no step is unstable."""
        states = self.states + 1 if self.fastest_rate is None else 0
        return self.tables.shape[1], states, len(self._times) + 1

    @cached_property
    def _remembered(self) -> dict[bytes, tuple[int, bool]]:
        """The place of each trial that was searched for, and whether it is lost, by the bits of its
        x."""
        return {}

    def _rungs_of(self, x: Array, offset: Array, *, guess: bool = False) -> ladder.Found:
        """Finds the rung of each trial, and the readings of those whose rung was searched for; with
        `guess` the rates say the rung, where the model has them."""
        trusted = self._trusted(x)
        remembered = self._remembered
        # The place of a trusted trial is 0; that of others is -1 until it is known.
        places = trusted.astype(np.intp) - 1
        unknown = np.flatnonzero(~trusted)
        if guess and len(unknown) and self.trusted_angle > 0 and self._rate_function is not None:
            places[unknown] = self._first_guess(x[unknown])
            unknown = unknown[:0]
        bits = [row.tobytes() for row in x[unknown]]
        lost = np.zeros(len(x), dtype=bool)
        doubtful = np.zeros_like(lost)
        for row, key in zip(unknown, bits, strict=True):
            places[row], lost[row] = remembered.get(key, (-1, False))
        new = np.flatnonzero(places[unknown] < 0)
        unknown = unknown[new]
        if not len(unknown):
            return ladder.Found(places, unknown, np.empty((0, self.m)), lost, doubtful)
        found = self._find(x[unknown], self._first_guess(x[unknown]), offset)
        if len(remembered) + len(unknown) > _REMEMBERED:
            remembered.clear()
        known = zip(found.places.tolist(), found.lost.tolist(), strict=True)
        remembered.update(zip([bits[i] for i in new], known, strict=True))
        places[unknown] = found.places
        lost[unknown] = found.lost
        return ladder.Found(places, unknown[found.computed], found.z, lost, doubtful)

    def _find(self, x: Array, start: ladder.Indices, offset: Array) -> ladder.Found:
        """Finds rungs; a trial with a step in doubt is lost unless its readings are those of the
        implicit method."""

        def simulate(rows: ladder.Indices, rung: int, z: Array, y: Array) -> None:
            self._simulate(x, rows, rung * self._parts, offset, z, y)

        asked = ladder.Asked(
            self._rungs, self._tolerances, self._kept, simulate, self.near, self._in_doubt
        )
        found = ladder.search(asked, start)
        doubtful = np.flatnonzero(found.doubtful & ~found.lost)
        if len(doubtful):
            z = found.z[np.searchsorted(found.computed, doubtful)] + offset
            implicit = self._implicit.simulate(x[doubtful], len(self.times))
            found.lost[doubtful] = ~self._alike(z, implicit)
        return found

    def _alike(self, z: Array, other: Array) -> Mask:
        """Selects the trials whose readings (trials, m) by two methods are alike."""
        with np.errstate(all="ignore"):
            off = ladder.shares(np.abs(z - self.near(other, z)), self._tolerances)
        return off.max(axis=1) <= ladder.NOT_FOLLOWED

    @cached_property
    def shape(self) -> tuple[Array, Effort]:
        """The nominal readings (1, m) by the implicit method, near enough to show their size, and
        what they took."""
        return Rodas5P(self.stepped, SHAPE).measured(own(self.nominal[None]))

    @cached_property
    def _implicit(self) -> Rodas5P:
        """The implicit method, more accurate than the tightest tolerance of a reading."""
        rtol = _IN_HAND * self._tightest / self._largest
        return Rodas5P(self.stepped, float(np.clip(rtol, 1e-10, 1e-4)))

    @cached_property
    def _tightest(self) -> float:
        """The least tolerance above 0, which is that of a reading of the exact start; 0 if there is
        none."""
        above = self._tolerances[self._tolerances > 0.0]
        return float(above.min()) if len(above) else 0.0

    @cached_property
    def _largest(self) -> float:
        """The largest nominal reading."""
        return float(np.nanmax(np.abs(self.shape[0]), initial=0.0)) or 1.0

    def _in_doubt(self, states: Array) -> Mask:
        """Selects the trials of states (trials, cases, states + 1, times + 1) in which a step was
        in doubt, or one that the rates divide by is negative though it never is at the
        start."""
        lowest = states[:, :, :-1].min(axis=(1, 3), initial=np.inf)
        below = (lowest < 0.0) & self._positive
        # The row behind the states counts, at the last time, the steps in doubt.
        doubts = states[:, :, -1:, -1].max(axis=(1, 2), initial=0.0)
        return (doubts > 0.0) | below.any(axis=1)

    @cached_property
    def _positive(self) -> Mask:
        """Selects the states that the rates divide by, and that are not negative with the shortest
        steps."""
        return self._divided_by & (self._with_shortest_steps[1] >= 0.0)

    @cached_property
    def _divided_by(self) -> Mask:
        """Selects the states that the rates divide by; none where no state is held against
        another."""
        states = self._kept[1]
        return np.array(watch.divided_by(Recording(self.equations))[:states], dtype=bool)

    @cached_property
    def _finest(self) -> Array:
        """The nominal readings (1, m) with the shortest steps, which meet what longer ones may pass
        over; not numbers if a step was in doubt, one that the rates divide by changes its sign, or
        none is watched."""
        return self._with_shortest_steps[0]

    def _told(self, x: Array, stop: int) -> Array:
        """Computes readings at the first `stop` times by the implicit method; not numbers from
        where on outputs magnify what its steps leave of the states, nor anywhere if at the
        start other steps lead to other readings."""
        return self._judged(*self._implicit.with_reach(x, stop), stop)

    def _judged(self, z: Array, reach: Array, stop: int) -> Array:
        """Removes readings (trials, readings) whose states' errors reach too far, and all after
        them."""
        along = len(z), self.tables.shape[1], stop, len(self.outputs)
        with np.errstate(all="ignore"):
            moved = reach / self._largest * self._tightest
            tolerances = self._tolerances[self.rows(stop)]
            astray = (moved > _MAGNIFIED * tolerances) & (tolerances > 0.0)
        at_time = astray.reshape(along).any(axis=3, keepdims=True)
        lost = np.logical_or.accumulate(at_time, axis=2) | (not self._is_held)
        return np.where(lost, np.nan, z.reshape(along)).reshape(z.shape)

    @cached_property
    def _nominal_reached(self) -> tuple[Array, Array]:
        return self._implicit.with_reach(own(self.nominal[None]), len(self.times))

    @cached_property
    def _nominal_told(self) -> Array:
        """The nominal readings (1, m) by the implicit method."""
        return self._judged(*self._nominal_reached, len(self.times))

    @cached_property
    def _is_held(self) -> bool:
        """Whether steps of the implicit method, ten times as accurate or not, lead to the same
        nominal readings, and to those of the shortest explicit steps, where these are told: what is
        smooth on both sides of a narrow well lets long steps agree that there is none."""
        z = self._nominal_reached[0]
        if not np.isfinite(z).all():
            return True
        rougher = replace(self._implicit, rtol=_ROUGHER * self._implicit.rtol)
        rough = rougher.simulate(own(self.nominal[None]), len(self.times))
        passed_over = np.isfinite(self._finest).all() and not self._alike(z, self._finest)[0]
        return bool(self._alike(z, rough)[0] and not passed_over)

    @cached_property
    def _with_shortest_steps(self) -> tuple[Array, Array]:
        """The nominal readings (1, m) and the lowest value of each state, at the readings, with the
        shortest steps."""
        z = np.full((1, self.m), np.nan)
        y = np.ones((1, *self._kept))
        if self.fastest_rate is None:
            x = own(self.nominal[None])
            steps = self._rungs[-1] * self._parts
            self._simulate(x, np.arange(1), steps, self._zeros, z, y)
        states = y[0, :, :-1]
        lowest = states.min(axis=(0, 2))
        highest = states.max(axis=(0, 2))
        turns_sign = (lowest < 0.0) & (highest > 0.0) & self._divided_by
        in_doubt = y[:, :, -1:, -1].any()
        if in_doubt or turns_sign.any():
            z[:] = np.nan
        return z, lowest

    @cached_property
    def _nominal(self) -> ladder.Found:
        """The rung of the start: with steps that are short enough to meet what the shortest
        meet."""
        x = own(self.nominal[None])
        told = np.isfinite(self._finest).all()
        place = 1
        while True:
            found = self._find(x, np.array([place]), self._zeros)
            place = max(place, int(found.places[0])) + 1
            passed_over = told and not self._alike(found.z, self._finest)[0]
            if found.lost[0] or not passed_over or place >= len(self._rungs) - 1:
                return found

    def _trusted(self, x: Array) -> Mask:
        """Selects the trials whose steps are fixed, or whose coarsest rung is known to suffice."""
        if self.step is not None or self.trusted_angle == 0:
            return np.full(len(x), self.step is not None)
        return self._rates(x) * self._longest <= self.trusted_angle

    def _rates(self, x: Array) -> Array:
        """Computes the rate of each trial; NaN where it is unknown."""
        rates = np.full(len(x), np.nan)
        if self._rate_function is not None:
            self._rate_function(x, self._si_sizes, rates)
        return rates

    @cached_property
    def _rate_function(self) -> Callable[[Array, Array, Array], None] | None:
        p = Graph().inputs("p", self.n)
        return self.fastest_rate and compiled_rates(Program.of([self.fastest_rate(p)], p))

    @cached_property
    def _longest(self) -> float:
        """The longest step of the coarsest rung."""
        steps = np.diff(self.times, prepend=0.0) / np.maximum(self._parts, 1)
        return float(np.max(steps))

    def _first_guess(self, x: Array) -> ladder.Indices:
        """Returns the place where the search begins: steps of half a radian, or what the nominal
        parameters need."""
        top = len(self._rungs) - 1
        if self._rate_function is None:
            usual = max(1, min(self._nominal_place, top - 1))
            return np.where(finite(x), usual, top)
        turned = self._rates(x) * self._longest
        wanted = np.nan_to_num(turned / _ANGLE_AT_START, nan=np.inf)
        return np.clip(np.searchsorted(self._rungs, wanted), 1, top)

    @cached_property
    def _nominal_place(self) -> int:
        return max(1, int(self._nominal.places[0]))

    @cached_property
    def _parts(self) -> NDArray[np.int64]:
        """Steps to each time at rung 1: equal ones, none longer than `step` or the usual interval,
        none over none."""
        intervals = np.diff(self.times, prepend=0.0)
        longest = self.step or self._usual_interval
        # Less a little, so that round-off makes no further step.
        steps = np.maximum(np.ceil(intervals / longest - 1e-9), 1)
        return np.where(intervals > 0.0, steps, 0).astype(np.int64)

    @cached_property
    def _usual_interval(self) -> float:
        """The median interval between readings, but for a few that are read one right after
        another."""
        span = float(self.times[-1])
        if not span:
            return 1.0
        median = float(np.median(np.diff(self.times, prepend=0.0)))
        return max(median, span / (8 * len(self.times)))

    @cached_property
    def _rungs(self) -> NDArray[np.int64]:
        finest = 1024.0 if self.shortest_step <= 0 else self._usual_interval / self.shortest_step
        return ladder.rungs_up_to(min(finest + 1e-9, 1024.0))

    @cached_property
    def _tolerances(self) -> Array:
        """Tolerance of each reading (m,)."""
        if self.tolerance is None:
            lacking = "states neither a step nor `tolerance`, the error that readings may have"
            raise UserError(
                f"measurement.step=null: {self.name} {lacking}; give one, as measurement.step=0.1"
            )
        per_output = np.broadcast_to(np.asarray(self.tolerance, dtype=float), len(self.outputs))
        return np.tile(per_output, self.m // len(self.outputs))

    def jacobian(self, x: Array) -> Array:
        return self.jacobian_until(x, len(self.times))

    def coarse_jacobian(self, x: Array) -> Array:
        return self.coarse_jacobian_until(x, len(self.times))

    def jacobian_until(self, x: Array, stop: int) -> Array:
        """Computes dh/dx by the variational equations, with the formula and the steps of the
        readings at that x."""
        x = own(x)
        groups = ladder.by_rung(self._rungs_of(x, self._zeros).places, np.arange(len(x)))
        given = ((self._jacobian_kernel, int(self._rungs[place]), rows) for place, rows in groups)
        return self._tangents(x, stop, given)

    def coarse_jacobian_until(self, x: Array, stop: int) -> Array:
        """Computes dh/dx with longer steps, or by a cheaper formula, if that was measured to
        contract; see `coarse`."""
        if not self._coarsens:
            return self.jacobian_until(x, stop)
        x = own(x)
        places = self._rungs_of(x, self._zeros, guess=stop < len(self.times)).places
        rungs = np.where(self._trusted(x), 0, self._rungs[places])
        groups = ladder.by_rung(rungs, np.arange(len(x)))
        return self._tangents(x, stop, ((*self._coarsened(rung), rows) for rung, rows in groups))

    @property
    def _coarsens(self) -> bool:
        """Whether there are longer steps for tangents."""
        return self.step is None

    def _tangents(
        self, x: Array, stop: int, groups: Iterable[tuple[Kernel, int, ladder.Indices]]
    ) -> Array:
        """Computes J (trials, readings, n) at the first times, each group of trials by its kernel
        at its rung."""
        J = np.empty((len(x), self.tables.shape[1] * stop * len(self.outputs), self.n))
        times = self._times[:stop]
        for kernel, rung, rows in groups:
            steps = rung * self._parts
            kernel.run(x, self._si_sizes, self.tables, rows, times, steps, J.reshape(-1))
        return J

    def _coarsened(self, rung: int) -> tuple[Kernel, int]:
        """Returns the formula and its steps for the tangents of trials at this rung; 0 for those
        that are trusted."""
        fourth, steps = self._coarseness.steps(rung)
        return self._rk4_kernel if fourth else self._jacobian_kernel, steps

    @cached_property
    def _coarseness(self) -> coarseness.Coarseness:
        """How much longer the steps of tangents may be, as measured at the start."""
        x = own(self.nominal[None])
        stop = len(self.times)
        rung = self._nominal_rung
        J = self.jacobian(x)

        def of_fourth(k: int) -> Array:
            return self._tangents(x, stop, [(self._rk4_kernel, k, np.arange(1))])[0]

        fourth = None
        if rung <= coarseness.HIGHEST_OF_FOURTH:
            fourth = coarseness.fewest_of_fourth(of_fourth, J[0])
        # Half the rung; where that is half a step, every second reading.
        if rung == 1 and (stop == 1 or self.driven is not None):
            return coarseness.Coarseness(fourth, 1.0)
        every = slice(None) if rung > 1 else slice(1, None, 2)
        rows = np.arange(self.m).reshape(self.tables.shape[1], stop, -1)[:, every].ravel()
        times = np.ascontiguousarray(self._times[every])
        steps = max(1, rung // 2) * self._parts[every]
        z = np.empty((1, len(rows)))
        coarse = np.empty((1, len(rows), self.n))
        given = (x, self._si_sizes, self.tables, np.arange(1), times, steps)
        self._readings_kernel.run(*given, np.zeros(len(rows)), z.reshape(-1))
        self._jacobian_kernel.run(*given, coarse.reshape(-1))
        exact = self._shown(x, stop, self._zeros)[:, rows]
        with np.errstate(all="ignore"):
            off = ladder.shares(np.abs(z - exact), self._tolerances[rows])
        return coarseness.Coarseness(fourth, coarseness.times_longer(off, coarse[0], J[0, rows]))

    @property
    def _nominal_rung(self) -> int:
        """The rung of the start, as its readings have it."""
        places = self._rungs_of(own(self.nominal[None]), self._zeros).places
        return int(self._rungs[places[0]])

    @cached_property
    def jacobian_cost(self) -> float:
        """Arithmetic operations of a step with all tangents, over those of a simulation's step."""
        return self._jacobian_kernel.plan.operations / self._readings_kernel.plan.operations

    @cached_property
    def coarse_jacobian_cost(self) -> float:
        """Cost at the nominal parameters, or where they are at a rung above 2; in simulations at
        the trial's rung."""
        if not self._coarsens:
            return self.jacobian_cost
        rung = self._nominal_rung
        trusted = self._trusted(own(self.nominal[None]))[0]
        kernel, steps = self._coarsened(0 if trusted else rung)
        return kernel.plan.operations * steps / (self._readings_kernel.plan.operations * rung)

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state without what is compiled and remembered, which stays with a process."""
        kept = self.__dict__.items()
        return {k: v for k, v in kept if not k.startswith("_") and k != "equations"}

    @cached_property
    def _readings_kernel(self) -> Kernel:
        return Kernel(self.equations, DOP853)

    @cached_property
    def _jacobian_kernel(self) -> Kernel:
        return Kernel(self.equations, DOP853, sensitive=True)

    @cached_property
    def _rk4_kernel(self) -> Kernel:
        return Kernel(self.equations, RK4, sensitive=True)

    @cached_property
    def equations(self) -> Equations:
        """Equations to integrate; refused where a rate jumps when the solution decides."""
        constants = self.tables.shape[2]
        driven = constants - self.cases.shape[1]
        watched = self.fastest_rate is None
        arithmetic = (self.start, self.rhs, self.read, self.variation, driven, watched)
        equations = Equations(self.states, self.n, constants, len(self.outputs), *arithmetic)
        if jumps(equations):
            what = (
                "a rate jumps at a moment that a state or a parameter decides,"
                " which no step can end at"
            )
            remedy = (
                "let both sides agree there, or blend them, as by 1/(1+exp((b-a)/width)) for a > b"
            )
            remedy += ", and write comparisons of t where floor or mod is taken of it"
            raise UserError(f"measurement={self.name}: {what}; {remedy}")
        return equations
