"""A gimballed INS that has more errors than the estimators' model knows: a truth to measure model mismatch with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.errors import UserError
from ipe_bench.linalg import Array
from ipe_bench.measurements.base import Parameter
from ipe_bench.measurements.gins import Gins
from ipe_bench.measurements.ode.kernel import integrate

_ARCSEC = np.pi / 180 / 3600
_DRIFTS = slice(4, 7)
"""Where dx, dy and dz stand among the parameters."""


@dataclass(frozen=True)
class RicherGins(Gins):
    """`Gins` with errors besides its eleven parameters, each drawn anew in every trial from N(0, deviation^2) whatever
    the error scale. At zero deviations it is `Gins`, and so it is for x of eleven columns.

    Random walk of the drifts: each reading interval of each case begins with an independent increment of deviation
    `gyro_random_walk` times the root of the interval, and the drift is constant within it, so the integration goes from
    reading to reading and keeps the tolerance of `Gins`.
    """

    gyro_random_walk: float = 0.0
    """Of each drift, deg/h per root hour."""
    accelerometer_quadratic: float = 0.0
    """Output that grows with the square of the specific force along each level axis, micro-g per g^2."""
    accelerometer_misalignment: float = 0.0
    """Angle by which each level accelerometer senses the other level axis, arc seconds. Sensing the vertical axis would
    be a bias, which the model has."""
    platform_misalignment: float = 0.0
    """Initial rotation of the platform about each of its axes, arc seconds."""

    name = "gins_richer"

    def __post_init__(self) -> None:
        for f in fields(RicherGins)[-4:]:
            if not (np.isfinite(getattr(self, f.name)) and getattr(self, f.name) >= 0):
                raise UserError(f"{f.name}={getattr(self, f.name)}: give a number from 0 up")

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

    def _readings(self, x: Array, steps: NDArray[np.int64], stop: int) -> Array:
        if x.shape[1] == self.n:
            return super()._readings(x, steps, stop)
        return self._walked(x, steps, stop)

    def _angle(self, x: Array) -> Array:
        """With the farthest that the drifts walk; such a trial is tested however slowly it turns."""
        if x.shape[1] == self.n:
            return super()._angle(x)
        walk = np.abs(self._walk(x)).reshape(len(x), -1).max(axis=1)
        angle = super()._angle(x[:, : self.n]) + np.sqrt(3.0) * walk * 60.0 * self.interval_min
        return np.maximum(angle, np.nextafter(self.trusted_angle, 1.0))

    def _walk(self, x: Array) -> Array:
        """How far the drifts have walked: (trials x cases, intervals, axes) in rad/s."""
        increments = x[:, self._motion.n :].reshape(len(x) * len(self.cases), self.readings_per_case, 3)
        return np.cumsum(increments, axis=1)

    def _walked(self, x: Array, steps: NDArray[np.int64], stop: int) -> Array:
        """Integrates from reading to reading, with the drifts of each interval: (trials, readings)."""
        motion, walk = self._motion, self._walk(x)
        p, c = motion._lanes(x[:, : motion.n])
        y = motion._start(p, c)
        interval = np.array([60.0 * self.interval_min])
        first = np.arange(len(p)) * motion.states
        z = np.empty((len(p), stop, 2))
        for k in range(stop):
            inputs = np.concatenate([p, c], axis=1)
            inputs[:, _DRIFTS] += walk[:, k]
            after = np.empty_like(y)
            # The right-hand side does not depend on time, so every interval may begin at 0.
            integrate(motion._plain, y, inputs, interval, steps[k : k + 1], after, first)
            y, z[:, k] = after, after[:, :2]
        return z.reshape(len(x), -1)

    @cached_property
    def _motion(self) -> _Motion:
        return _Motion(**{f.name: getattr(self, f.name) for f in fields(Gins)})


@dataclass(frozen=True)
class _Motion(Gins):
    """The equations of motion with the constant errors among the parameters, and the whole state as output."""

    outputs = tuple(f"y{i}" for i in range(Gins.states))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*super().parameters, *(Parameter(name) for name in ("qx", "qy", "mxy", "myx", "px", "py", "pz")))

    @cached_property
    def si_sizes(self) -> Array:
        return np.concatenate([Gins(gravity=self.gravity).si_sizes, np.ones(7)])

    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """The platform is turned about x, then y, then z: true up and Earth axis turn the other way in its axes."""
        y = super().start(p, c)
        up, earth = _turned(y[2:5], p[15:18]), _turned(y[5:8], p[15:18])
        return [*y[:2], *up, *earth, *y[8:11]]

    def sensed(self, f: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        qx, qy, mxy, myx = p[11:15]
        return f[0] + qx * f[0] * f[0] + mxy * f[1], f[1] + qy * f[1] * f[1] + myx * f[0]

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return y


def _turned(v: Sequence[Any], angles: Sequence[NDArray[Any]]) -> list[Any]:
    """A fixed vector in axes that turn by the angles about x, then y, then z."""
    a, b, c = v
    x, y, z = angles
    b, c = np.cos(x) * b + np.sin(x) * c, np.cos(x) * c - np.sin(x) * b
    c, a = np.cos(y) * c + np.sin(y) * a, np.cos(y) * a - np.sin(y) * c
    a, b = np.cos(z) * a + np.sin(z) * b, np.cos(z) * b - np.sin(z) * a
    return [a, b, c]
