"""Measurement models whose readings are taken from the solution of ordinary differential equations.

The author writes the right-hand side once, in plain arithmetic; the batched compiled integrator and the exact Jacobian
come from it. Recording and compilation are in `trace` and `kernel`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.linalg import Array
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.ode.kernel import Recording, integrate, record
from ipe_bench.measurements.ode.levels import Found, Indices, Remembered, Search, grouped, ladder

_COMPLEX_STEP = 1e-100
_BLOCK = 256
"""Trials whose derivatives are integrated together: few enough to stay in the cache."""


_ANGLE_AT_START = 0.5
"""Radians over which the first step that is tried lets the solution turn."""


class OdeMeasurement(Measurement):
    """Readings of y' = rhs(t, y, p, c) at given times, for one or more cases that share the parameters.

    A subclass states `states`, `outputs`, `tolerance`, `parameters` and `times`, and writes `start`, `rhs` and `read`;
    the package's docstring has an example. p are the parameters in SI units (x times `si_sizes`), c the constants of a
    case. The three functions use + - * / ** and NumPy's elementary functions on the entries of their arguments, and
    nothing that asks for a value (no if, no comparison). z has C order over (case, time, output); a time is an epoch.
    """

    states: ClassVar[int]
    """Number of state variables."""
    outputs: ClassVar[tuple[str, ...]]
    """The names of what is read at each time."""
    time_unit: ClassVar[str] = "s"
    """The unit of `times`, `step` and t."""
    tolerance: float | Sequence[float] | None = None
    """The error that the integration may leave in a reading, in `reading_unit`; or one such error for each output.
    Each trial's step follows from it and from the trial's parameters."""
    step: float | None = None
    """A longest step for all trials, in place of `tolerance`; each interval between readings is divided evenly."""
    shortest_step: float = 0.0
    """Steps do not become shorter than about this, however wild the parameters, nor than 1/1024 of the usual interval
    between readings: what an iterate that diverges may cost."""
    trusted_angle: float = 0.0
    """A step that is at most this over `rate` is known to hold the tolerance; 0: every trial is tested."""

    @property
    @abstractmethod
    def times(self) -> Array:
        """The times of the readings (times,) in seconds after the start at 0, ascending."""

    @property
    def cases(self) -> Array:
        """The constants of each case: (cases, constants). One case without constants unless overridden."""
        return np.zeros((1, 0))

    @property
    def si_sizes(self) -> Array:
        """The size (n,) of one unit of x in SI units."""
        return self.sizes

    @abstractmethod
    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """The state at time 0."""

    @abstractmethod
    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """The time derivative of the state."""

    @abstractmethod
    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """What the instruments show of the state, one entry per output."""

    def rate(self, p: Sequence[Array]) -> Array | None:
        """How fast each trial's solution may turn, grow or decay (trials,), per unit of time, from the parameters
        (n, trials); None where nothing is known. It says with which step the search begins, no more."""
        del p
        return None

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        cases, times, outputs = np.meshgrid(
            np.arange(1, len(self.cases) + 1), self.times, np.arange(len(self.outputs)), indexing="ij"
        )
        return {
            "case": cases.ravel().tolist(),
            f"time [{self.time_unit}]": times.ravel().tolist(),
            "output": [self.outputs[i] for i in outputs.ravel()],
        }

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        """One epoch per time, with the readings of all cases and outputs."""
        rows = np.arange(self.m).reshape(len(self.cases), len(self.times), len(self.outputs))
        return tuple(np.ascontiguousarray(rows[:, k]).ravel() for k in range(len(self.times)))

    def simulate(self, x: Array) -> Array:
        return self.simulate_until(x, len(self.times))

    def simulate_until(self, x: Array, stop: int) -> Array:
        if self.step is not None:
            return self._readings(x, self._fixed_steps(self.step), stop)
        found = self._search(x)
        z = np.empty((len(x), len(self.cases) * stop * len(self.outputs)))
        z[found.computed] = self._prefix(found.z, stop)
        others = np.delete(np.arange(len(x)), found.computed)
        for place, rows in grouped(found.places[others], others):
            z[rows] = self._readings(x[rows], self._steps(place), stop)
        return z

    def _readings(self, x: Array, steps: NDArray[np.int64], stop: int) -> Array:
        """Readings (trials, readings) up to the time `stop`, with so many steps to each time."""
        p, c = self._lanes(x)
        per_case = stop * len(self.outputs)
        z = np.empty((len(x), len(self.cases) * per_case))
        first = per_case * np.arange(len(p))
        self._integrate(self._plain, self._start(p, c), np.concatenate([p, c], axis=1), steps, stop, z, first)
        return z

    def _prefix(self, z: Array, stop: int) -> Array:
        shape = (len(z), len(self.cases), len(self.times), len(self.outputs))
        return z.reshape(shape)[:, :, :stop].reshape(len(z), len(self.cases) * stop * len(self.outputs))

    def _search(self, x: Array) -> Found:
        """The level of each trial, and the readings of those whose level had to be looked for."""
        places = self._trusted(x)
        unknown = np.flatnonzero(places < 0)
        places[unknown] = self._remembered.look_up(x[unknown])
        unknown = unknown[places[unknown] < 0]
        if not len(unknown):
            return Found(places, unknown, np.empty((0, self.m)))
        found = self._find(x[unknown], self._first_guess(x[unknown]))
        self._remembered.keep(x[unknown], found.places)
        places[unknown] = found.places
        return Found(places, unknown[found.computed], found.z)

    def _find(self, x: Array, start: Indices) -> Found:
        def readings(rows: Indices, level: int) -> Array:
            return self._readings(x[rows], level * self._parts, len(self.times))

        return Search(self._ladder, self._tolerances, readings).run(start)

    def _trusted(self, x: Array) -> Indices:
        """The coarsest level for trials of which it is known to do, -1 for the others."""
        if self.trusted_angle == 0:
            return np.full(len(x), -1)
        return np.where(self._angle(x) <= self.trusted_angle, 0, -1)

    def _angle(self, x: Array) -> Array:
        """The coarsest step times the rate (trials,); not a number where nothing is known."""
        rate = self.rate(list((x * self.si_sizes).T))
        if rate is None:
            return np.full(len(x), np.nan)
        longest = np.max(np.diff(self.times, prepend=0.0) / self._parts)
        return np.broadcast_to(rate * longest, len(x))

    def _first_guess(self, x: Array) -> Indices:
        """Where on the ladder the search begins: steps of half a radian, or what the nominal parameters need."""
        angle = self._angle(x)
        if np.isnan(angle).all() and np.isfinite(x).all():
            return np.full(len(x), self._nominal_place)
        wanted = np.nan_to_num(angle / _ANGLE_AT_START, nan=np.inf)
        return np.clip(np.searchsorted(self._ladder, wanted), 1, len(self._ladder) - 1)

    @cached_property
    def _nominal_place(self) -> int:
        return max(1, int(self._find(self.nominal[None], np.array([1])).places[0]))

    @cached_property
    def _remembered(self) -> Remembered:
        return Remembered()

    @cached_property
    def _parts(self) -> NDArray[np.int64]:
        """Steps to each time at level 1: one, and more where the interval is longer than usual."""
        intervals = np.diff(self.times, prepend=0.0)
        return np.maximum(np.ceil(intervals / np.median(intervals) - 1e-9), 1).astype(np.int64)

    @cached_property
    def _ladder(self) -> NDArray[np.int64]:
        usual = float(np.median(np.diff(self.times, prepend=0.0)))
        finest = 1024.0 if self.shortest_step <= 0 else usual / self.shortest_step
        return ladder(min(finest + 1e-9, 1024.0))

    @cached_property
    def _tolerances(self) -> Array:
        """What each reading (m,) may be off by."""
        if self.tolerance is None:
            raise ValueError(f"{self.name}: state `tolerance`, the error that a reading may have, or a fixed `step`")
        per_output = np.broadcast_to(np.asarray(self.tolerance, dtype=float), len(self.outputs))
        return np.tile(per_output, self.m // len(self.outputs))

    def _steps(self, place: int) -> NDArray[np.int64]:
        return self._ladder[place] * self._parts

    def _fixed_steps(self, step: float) -> NDArray[np.int64]:
        intervals = np.diff(self.times, prepend=0.0)
        return np.maximum(np.ceil(intervals / step - 1e-9), 1).astype(np.int64)

    def jacobian(self, x: Array) -> Array:
        return self.jacobian_until(x, len(self.times))

    def jacobian_until(self, x: Array, stop: int) -> Array:
        """dh/dx by the variational equations, integrated by the same formula and steps as the readings of that x."""
        J = np.empty((len(x), len(self.cases) * stop * len(self.outputs), self.n))
        for rows, steps in self._grouped_by_steps(x):
            for begin in range(0, len(rows), _BLOCK):
                block = rows[begin : begin + _BLOCK]
                part = np.empty((len(block), *J.shape[1:]))
                self._differentiate(x[block], steps, stop, part)
                J[block] = part
        return J

    def _grouped_by_steps(self, x: Array) -> list[tuple[Indices, NDArray[np.int64]]]:
        """The trials that share a level, and its steps."""
        everyone = np.arange(len(x))
        if self.step is not None:
            return [(everyone, self._fixed_steps(self.step))]
        places = self._search(x).places
        return [(rows, self._steps(place)) for place, rows in grouped(places, everyone)]

    def _differentiate(self, x: Array, steps: NDArray[np.int64], stop: int, J: Array) -> None:
        """Fills J (trials, readings, n): a lane for each trial, direction and case."""
        trials, n = x.shape
        p, c = self._lanes(np.repeat(x, n, axis=0))
        direction = np.repeat(np.tile(np.eye(n), (trials, 1)), len(self.cases), axis=0) * self.si_sizes
        y = self._start(p + 1j * _COMPLEX_STEP * direction, c)
        y0 = np.concatenate([np.real(y), np.imag(y) / _COMPLEX_STEP], axis=1)
        inputs = np.concatenate([p, c, direction], axis=1)
        shape = (trials, len(self.cases), stop * len(self.outputs), n)
        first = np.arange(J.size).reshape(shape)[:, :, 0].swapaxes(1, 2).ravel()
        self._integrate(self._tangent, y0, inputs, steps, stop, J, first, stride=n)

    def _lanes(self, x: Array) -> tuple[Array, Array]:
        """Parameters and constants of every initial value problem: each trial in each case."""
        p = np.repeat(x * self.si_sizes, len(self.cases), axis=0)
        return p, np.tile(self.cases, (len(x), 1))

    def _start(self, p: NDArray[Any], c: Array) -> NDArray[Any]:
        return np.stack(np.broadcast_arrays(*self.start(list(p.T), list(c.T)), p[:, 0])[:-1], axis=1)

    def _integrate(
        self,
        recording: Recording,
        y0: Array,
        inputs: Array,
        steps: NDArray[np.int64],
        stop: int,
        out: Array,
        first: NDArray[np.int64],
        stride: int = 1,
    ) -> None:
        times = np.asarray(self.times[:stop], dtype=float)
        integrate(recording, y0, inputs, times, steps[:stop], out, first, stride)

    @cached_property
    def _plain(self) -> Recording:
        return self._record(varying=0)

    @cached_property
    def _tangent(self) -> Recording:
        return self._record(varying=self.n)

    def _record(self, *, varying: int) -> Recording:
        n = self.n

        def rhs(t: Any, y: Sequence[Any], p: Sequence[Any]) -> Sequence[Any]:
            return self.rhs(t, y, p[:n], p[n:])

        def read(t: Any, y: Sequence[Any], p: Sequence[Any]) -> Sequence[Any]:
            return self.read(t, y, p[:n], p[n:])

        inputs = n + self.cases.shape[1]
        return record(rhs, read, self.states, inputs, len(self.outputs), varying=varying)
