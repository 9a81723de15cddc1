"""A gimballed INS that has more errors than the estimators' model knows: a truth to measure model mismatch with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import NonNegative
from ipe_bench.measurements.base import Parameter
from ipe_bench.measurements.gins import Gins
from ipe_bench.measurements.ode.integrator import Kernel
from ipe_bench.measurements.ode.plan import Equations
from ipe_bench.measurements.ode.tableau import DOP853

_ARCSEC = np.pi / 180 / 3600
_DRIFTS = slice(4, 7)
"""Where dx, dy and dz stand among the parameters."""
_SENSED, _CONSTANT = 4, 7
"""Errors of the accelerometers, and with them the three rotations of the platform."""


@dataclass(frozen=True)
class RicherGins(Gins):
    """`Gins` with errors besides its eleven parameters, each drawn anew in every trial from N(0, deviation^2) whatever
    the error scale. At zero deviations it is `Gins`, and so it is for x of eleven columns.

    Random walk of the drifts: each reading interval of each case begins with an independent increment of deviation
    `gyro_random_walk` times the root of the interval, and the drift is constant within it, so the integration goes from
    reading to reading and keeps the tolerance of `Gins`.
    """

    gyro_random_walk: NonNegative = 0.0
    """Of each drift, deg/h per root hour."""
    accelerometer_quadratic: NonNegative = 0.0
    """Output that grows with the square of the specific force along each level axis, micro-g per g^2."""
    accelerometer_misalignment: NonNegative = 0.0
    """Angle by which each level accelerometer senses the other level axis, arc seconds. Sensing the vertical axis would
    be a bias, which the model has."""
    platform_misalignment: NonNegative = 0.0
    """Initial rotation of the platform about each of its axes, arc seconds."""

    name = "gins_richer"

    @cached_property
    def nuisance_deviation(self) -> Array:
        """Per trial: 2 quadratic coefficients in 1 / (m/s^2), 2 misalignments and 3 rotations in rad, then the
        increments of dx, dy, dz in rad/s in C order over (case, interval, axis)."""
        hours = self.interval_min / 60.0
        drift = self.si_sizes[4] / self.parameters[4].size
        walk = np.full(len(self.cases) * self.readings_per_case * 3, self.gyro_random_walk * drift * np.sqrt(hours))
        quadratic = self.accelerometer_quadratic * 1e-6 / self.gravity
        angles = np.repeat([self.accelerometer_misalignment * _ARCSEC, self.platform_misalignment * _ARCSEC], [2, 3])
        return np.concatenate([[quadratic, quadratic], angles, walk])

    @property
    def nuisances(self) -> tuple[Parameter, ...]:
        """In the units of the options that set their deviations; the walk's increments in deg/h."""
        quadratic, across, tilt = "accelerometer quadratic", "accelerometer misalignment", "platform tilt"
        drift = self.parameters[4].size / self.si_sizes[4]
        return (
            *(Parameter(f"quadratic {axis}", "micro-g/g^2", self.gravity / 1e-6, quadratic) for axis in "xy"),
            *(Parameter(f"misalignment {axes}", "arcsec", 1 / _ARCSEC, across) for axes in ("xy", "yx")),
            *(Parameter(f"tilt {axis}", "arcsec", 1 / _ARCSEC, tilt) for axis in "xyz"),
            *(
                Parameter(f"walk d{axis} {case}.{k}", "deg/h", drift, "gyro random walk")
                for case in range(1, len(self.cases) + 1)
                for k in range(1, self.readings_per_case + 1)
                for axis in "xyz"
            ),
        )

    def _simulate(self, x: Array, rows: NDArray[np.intp], steps: NDArray[np.int64], offset: Array, z: Array) -> None:
        if x.shape[1] == self.n:
            super()._simulate(x, rows, steps, offset, z)
        else:
            stop = z.shape[1] // (2 * len(self.cases))
            z[rows] = self._walked(x[rows], steps, stop) - offset[self.rows(stop)]

    def _rates(self, x: Array) -> tuple[Array, float]:
        """With the farthest that the drifts walk; such a trial is tested however slowly it turns."""
        if x.shape[1] == self.n:
            return super()._rates(x)
        walk = np.abs(self._walk(x)).reshape(len(x), -1).max(axis=1)
        rates = super()._rates(np.ascontiguousarray(x[:, : self.n]))[0] + np.sqrt(3.0) * walk
        return np.maximum(rates, np.nextafter(self.trusted_angle / self._longest, np.inf)), np.inf

    def _walk(self, x: Array) -> Array:
        """How far the drifts have walked: (trials x cases, intervals, axes) in rad/s."""
        increments = x[:, self.n + _CONSTANT :].reshape(len(x) * len(self.cases), self.readings_per_case, 3)
        return np.cumsum(increments, axis=1)

    def _walked(self, x: Array, steps: NDArray[np.int64], stop: int) -> Array:
        """Integrates from reading to reading, with the drifts of each interval: (trials, readings)."""
        walk, cases = self._walk(x), len(self.cases)
        constant = np.concatenate([x[:, : self.n] * self.si_sizes, x[:, self.n : self.n + _CONSTANT]], axis=1)
        p = np.repeat(constant, cases, axis=0)
        y = self._tilted(p, np.tile(self.cases, (len(x), 1)))
        interval = np.array([60.0 * self.interval_min])
        z = np.empty((len(p), stop, 2))
        for k in range(stop):
            inputs = np.concatenate([p[:, : self.n + _SENSED], y], axis=1)
            inputs[:, _DRIFTS] += walk[:, k]
            # The right-hand side does not depend on time, so every interval may begin at 0.
            self._motion.run(
                inputs,
                np.ones(inputs.shape[1]),
                np.zeros((1, 0)),
                np.arange(len(p)),
                interval,
                steps[k : k + 1],
                np.zeros(self.states),
                y.reshape(-1),
            )
            z[:, k] = y[:, :2]
        return z.reshape(len(x), cases * stop * 2)

    def _tilted(self, p: Array, c: Array) -> Array:
        """The platform is turned about x, then y, then z: true up and Earth axis turn the other way in its axes."""
        y = self.start(list(p.T), list(c.T))
        turns = list(p[:, self.n + _SENSED :].T)
        y = [*y[:2], *_turned(y[2:5], turns), *_turned(y[5:8], turns), *y[8:11]]
        return np.stack([np.broadcast_to(v, len(p)) for v in y], axis=1)

    @cached_property
    def _motion(self) -> Kernel:
        """From one reading to the next: the parameters, the errors of the accelerometers and the state, as it was."""
        moving = _Motion(**{f.name: getattr(self, f.name) for f in fields(Gins)})
        given = self.n + _SENSED

        def start(p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
            return p[given:]

        def read(t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
            return y

        equations = Equations(self.states, given + self.states, 0, self.states, start, moving.rhs, read)
        return Kernel(equations, DOP853)


class _Motion(Gins):
    """The equations of motion with the errors of the accelerometers behind the parameters."""

    def acceleration(self, u: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        bx, by, kx, ky = p[:4]
        qx, qy, mxy, myx = p[11:15]
        fx, fy = self.gravity * u[0], self.gravity * u[1]
        x, y = fx + qx * fx * fx + mxy * fy, fy + qy * fy * fy + myx * fx
        return (1.0 + kx) * x + bx, (1.0 + ky) * y + by


def _turned(v: Sequence[Any], angles: Sequence[NDArray[Any]]) -> list[Any]:
    """A fixed vector in axes that turn by the angles about x, then y, then z."""
    a, b, c = v
    x, y, z = angles
    b, c = np.cos(x) * b + np.sin(x) * c, np.cos(x) * c - np.sin(x) * b
    c, a = np.cos(y) * c + np.sin(y) * a, np.cos(y) * a - np.sin(y) * c
    a, b = np.cos(z) * a + np.sin(z) * b, np.cos(z) * b - np.sin(z) * a
    return [a, b, c]
