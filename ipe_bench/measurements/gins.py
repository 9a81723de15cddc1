"""The gimballed inertial navigation system (GINS) of the paper, section IV: eleven error parameters, 240 velocities.

A stabilised platform on a stationary bench; axes x east, y north, z up at the start, wander azimuth, spherical Earth.
An injected initial velocity error swings the platform at the Schuler period, which makes scale-factor and
mass-unbalance errors observable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Parameter, UsualNoise
from ipe_bench.measurements.ode.model import OdeMeasurement

FOOT = 0.3048
"""Metres in a foot."""
_DEGREE_PER_HOUR = np.pi / 180 / 3600

_LONGEST_STEPS = ((300.0, 180.0), (600.0, 45.0), (1000.0, 30.0), (2000.0, 20.0), (np.inf, 10.0))
"""(error scale, step in s): up to that scale the step keeps every reading within 1e-6 m/s."""


def _cross(a: Sequence[Any], b: Sequence[Any]) -> tuple[Any, Any, Any]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@dataclass(frozen=True)
class Gins(OdeMeasurement):
    """Velocity errors of a gimballed INS over 90 minutes after an injected velocity, in four cases.

    Parameters, in multiples of the paper's Table 1: accelerometer biases, accelerometer scale-factor errors, gyro
    drifts, and gyro mass unbalances. Readings in m/s in C order over (case 4, time 30, axis 2), less the velocities of
    the error-free system, so h(0) = 0.

    `step` is the integration step in s; None chooses it by the error scale so that the readings are within 1e-6 m/s.
    """

    latitude_deg: float = 36.35
    earth_radius: float = 6378137.0
    gravity: float = 9.80665
    earth_rate: float = 7.292115e-5
    injected_ft_per_s: float = 1500.0
    interval_min: float = 3.0
    readings_per_case: int = 30
    step: float | None = None

    reading_unit = "m/s"
    usual_noise = UsualNoise(step=0.02286)
    states = 11
    outputs = ("vx", "vy")

    def suited_to(self, error_scale: float) -> Gins:
        if self.step is not None:
            return self
        return replace(self, step=next(step for scale, step in _LONGEST_STEPS if error_scale <= scale))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        bias, scale = "accelerometer bias", "accelerometer scale factor"
        drift, azimuth, unbalance = "gyro drift x, y", "gyro drift z", "gyro mass unbalance"
        return (
            Parameter("bx", "g", 1e-4, bias),
            Parameter("by", "g", 1e-4, bias),
            Parameter("kx", "ppm", 100.0, scale),
            Parameter("ky", "ppm", 100.0, scale),
            Parameter("dx", "deg/h", 0.01, drift),
            Parameter("dy", "deg/h", 0.01, drift),
            Parameter("dz", "deg/h", 0.1, azimuth),
            *(Parameter(name, "deg/h/g", 0.2, unbalance) for name in ("Dxx", "Dxy", "Dyx", "Dyy")),
        )

    @cached_property
    def si_sizes(self) -> Array:
        """m/s^2 for biases, 1 for scale factors, rad/s for drifts and for unbalances (per specific force in g)."""
        si = {"g": self.gravity, "ppm": 1e-6, "deg/h": _DEGREE_PER_HOUR, "deg/h/g": _DEGREE_PER_HOUR}
        return np.array([p.size * si[p.unit] for p in self.parameters])

    @cached_property
    def times(self) -> Array:
        return 60.0 * self.interval_min * np.arange(1, self.readings_per_case + 1)

    @cached_property
    def cases(self) -> Array:
        """Injected velocity (x, y) in m/s: along x, along y, against x, against y."""
        return self.injected_ft_per_s * FOOT * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        columns = super().index
        minutes = [round(t / 60.0, 6) for t in columns["time [s]"]]
        return {"case": columns["case"], "time [min]": minutes, "axis": columns["output"]}

    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        north, up = np.cos(np.deg2rad(self.latitude_deg)), np.sin(np.deg2rad(self.latitude_deg))
        return [c[0], c[1], 0.0, 0.0, 1.0, 0.0, north, up, 0.0, north, up]

    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """State: computed velocity (vx, vy); true up u and true Earth axis e in platform axes; c, the Earth axis as
        the computer believes, in computer axes."""
        vx, vy, u, e, c = y[0], y[1], y[2:5], y[5:8], y[8:11]
        bx, by, kx, ky = p[:4]
        f = self.specific_force(t, u, p)
        fx, fy = self.sensed(f, p)
        ax = (1.0 + kx) * fx + bx
        ay = (1.0 + ky) * fy + by
        curvature = 1.0 / self.earth_radius
        transport = (-vy * curvature, vx * curvature, 0.0)
        command = [self.earth_rate * ci + rho for ci, rho in zip(c, transport, strict=True)]
        rate = [wc + d for wc, d in zip(command, self.drift(t, f, p), strict=True)]
        coriolis = 2.0 * self.earth_rate * c[2]
        turning = [self.earth_rate * w for w in _cross(e, u)]
        return [
            ax + coriolis * vy,
            ay - coriolis * vx,
            *(w - r for w, r in zip(turning, _cross(rate, u), strict=True)),
            *(-r for r in _cross(rate, e)),
            *(-r for r in _cross(command, c)),
        ]

    def specific_force(self, t: Any, u: Sequence[Any], p: Sequence[Any]) -> Sequence[Any]:
        """Specific force in platform axes, m/s^2."""
        return [self.gravity * ui for ui in u]

    def sensed(self, f: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        """What the accelerometers x and y respond to, before scale factor and bias, m/s^2."""
        return f[0], f[1]

    def drift(self, t: Any, f: Sequence[Any], p: Sequence[Any]) -> Sequence[Any]:
        """Drift rate of the platform about its axes, rad/s."""
        dx, dy, dz, Dxx, Dxy, Dyx, Dyy = p[4:11]
        fx, fy = f[0] * (1.0 / self.gravity), f[1] * (1.0 / self.gravity)
        return dx + Dxx * fx + Dxy * fy, dy + Dyx * fx + Dyy * fy, dz

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return y[0], y[1]

    def simulate_until(self, x: Array, stop: int) -> Array:
        return super().simulate_until(x, stop) - self.offset[self.rows(stop)]

    @cached_property
    def offset(self) -> Array:
        """The velocities (m,) of the error-free system, which the read-out shows as well."""
        return super().simulate_until(np.zeros((1, self.n)), len(self.times))[0]

    def linearization(self) -> Array:
        """H (m, n) as the paper builds it: the readings at one unit of each parameter, secants rather than slopes."""
        return np.ascontiguousarray(self.simulate(np.eye(self.n)).T)
