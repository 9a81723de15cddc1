"""Measurement models whose readings are taken from the solution of ordinary differential equations.

The author writes the right-hand side once, in plain arithmetic; the batched compiled integrator and the exact Jacobian
come from it. Recording and compilation are in `trace` and `kernel`.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Input, Measurement
from ipe_bench.measurements.ode import sampling
from ipe_bench.measurements.ode.kernel import Recording, integrate, record

_COMPLEX_STEP = 1e-100
_BLOCK = 256
"""Trials whose derivatives are integrated together: few enough to stay in the cache."""


class OdeMeasurement(Measurement):
    """Readings of y' = rhs(t, y, p, c) at given times, for one or more cases that share the parameters.

    A subclass states `states`, `outputs`, `step`, `parameters` and `times`, and writes `start`, `rhs` and `read`; the
    package's docstring has an example. p are the parameters in SI units (x times `si_sizes`), c the constants of a
    case. The three functions use + - * / ** and NumPy's elementary functions on the entries of their arguments, and
    nothing that asks for a value (no if, no comparison). z has C order over (case, time, output); a time is an epoch.
    """

    states: ClassVar[int]
    """Number of state variables."""
    outputs: ClassVar[tuple[str, ...]]
    """The names of what is read at each time."""
    time_unit: ClassVar[str] = "s"
    """The unit of `times`, `step` and t."""
    step: float | None
    """The longest integration step in seconds; each interval between readings is divided evenly."""
    sampled: tuple[float, ...] | None = None
    """Times of the readings in place of the usual ones, where a subclass has a field of that name: a readings file may
    bring its own."""

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

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        cases, times, outputs = np.meshgrid(
            np.arange(1, len(self.cases) + 1), self.times, np.arange(len(self.outputs)), indexing="ij"
        )
        return {
            "case": cases.ravel().tolist(),
            sampling.time_heading(self.time_unit): times.ravel().tolist(),
            "output": [self.outputs[i] for i in outputs.ravel()],
        }

    @property
    def inputs(self) -> tuple[Input, ...]:
        if "sampled" not in getattr(self, "__dataclass_fields__", {}):
            return ()
        return sampling.inputs(self.time_unit, self.outputs, len(self.cases))

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        def at(times: tuple[float, ...]) -> Measurement:
            return self if np.array_equal(times, self.times) else dataclasses.replace(self, sampled=times)  # type: ignore[type-var]

        return sampling.sampled(columns, self.outputs, len(self.cases), at)

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        """One epoch per time, with the readings of all cases and outputs."""
        rows = np.arange(self.m).reshape(len(self.cases), len(self.times), len(self.outputs))
        return tuple(np.ascontiguousarray(rows[:, k]).ravel() for k in range(len(self.times)))

    def simulate(self, x: Array) -> Array:
        return self.simulate_until(x, len(self.times))

    def simulate_until(self, x: Array, stop: int) -> Array:
        p, c = self._lanes(x)
        per_case = stop * len(self.outputs)
        z = np.empty((len(x), len(self.cases) * per_case))
        first = per_case * np.arange(len(p))
        self._integrate(self._plain, self._start(p, c), np.concatenate([p, c], axis=1), stop, z, first)
        return z

    def jacobian(self, x: Array) -> Array:
        return self.jacobian_until(x, len(self.times))

    def jacobian_until(self, x: Array, stop: int) -> Array:
        """dh/dx by the variational equations, integrated by the same compiled formula as the readings."""
        J = np.empty((len(x), len(self.cases) * stop * len(self.outputs), self.n))
        for begin in range(0, len(x), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            self._differentiate(x[block], stop, J[block])
        return J

    def _differentiate(self, x: Array, stop: int, J: Array) -> None:
        """Fills J (trials, readings, n): a lane for each trial, direction and case."""
        trials, n = x.shape
        p, c = self._lanes(np.repeat(x, n, axis=0))
        direction = np.repeat(np.tile(np.eye(n), (trials, 1)), len(self.cases), axis=0) * self.si_sizes
        y = self._start(p + 1j * _COMPLEX_STEP * direction, c)
        y0 = np.concatenate([np.real(y), np.imag(y) / _COMPLEX_STEP], axis=1)
        inputs = np.concatenate([p, c, direction], axis=1)
        shape = (trials, len(self.cases), stop * len(self.outputs), n)
        first = np.arange(J.size).reshape(shape)[:, :, 0].swapaxes(1, 2).ravel()
        self._integrate(self._tangent, y0, inputs, stop, J, first, stride=n)

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
        stop: int,
        out: Array,
        first: NDArray[np.int64],
        stride: int = 1,
    ) -> None:
        if self.step is None:
            raise ValueError(f"{self.name}: the integration step is not chosen yet; see suited_to")
        times = np.asarray(self.times[:stop], dtype=float)
        substeps = np.ceil(np.diff(times, prepend=0.0) / self.step - 1e-9).astype(np.int64)
        integrate(recording, y0, inputs, times, np.maximum(substeps, 1), out, first, stride)

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
