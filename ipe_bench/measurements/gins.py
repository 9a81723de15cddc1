"""The gimballed inertial navigation system (GINS) of the paper, section IV: eleven error parameters, 240 velocities.

A stabilised platform on a stationary bench; axes x east, y north, z up at the start, wander azimuth, spherical Earth.
An injected initial velocity error swings the platform at the Schuler period, which makes scale-factor and
mass-unbalance errors observable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements.base import Parameter, UsualNoise
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.measurements.ode.source import Variation
from ipe_bench.measurements.ode.trace import tangent

FOOT = 0.3048
"""Metres in a foot."""
_DEGREE_PER_HOUR = np.pi / 180 / 3600


def _cross(a: Sequence[Any], b: Sequence[Any]) -> tuple[Any, Any, Any]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _length(*components: Any) -> Any:
    return np.sqrt(sum(v * v for v in components))


@dataclass(frozen=True)
class Gins(OdeMeasurement):
    """Velocity errors of a gimballed INS over 90 minutes after an injected velocity, in four cases.

    Parameters, in multiples of the paper's Table 1: accelerometer biases, accelerometer scale-factor errors, gyro
    drifts, and gyro mass unbalances. Readings in m/s in C order over (case 4, time 30, axis 2), less the velocities of
    the error-free system, so h(0) = 0.

    `step` is the integration step in s; None chooses it for each trial by its parameters, so that the readings are
    within 1e-6 m/s to an error scale of 5000. At 10,000 round-off itself leaves up to 1.3e-6 in one trial of 2,000.
    """

    latitude_deg: float = 36.35
    earth_radius: float = 6378137.0
    gravity: float = 9.80665
    earth_rate: float = 7.292115e-5
    injected_ft_per_s: float = 1500.0
    interval_min: Positive = 3.0
    readings_per_case: Count = 30
    step: Positive | None = None

    reading_unit = "m/s"
    usual_noise = UsualNoise(step=0.02286)
    states = 11
    outputs = ("vx", "vy")

    tolerance = 1e-6
    shortest_step = 180.0 / 64

    @cached_property
    def trusted_angle(self) -> float:
        """Of 9,000 draws at 0.32, sparse and lopsided ones among them, the worst is off by 2.5e-8 m/s; that holds for
        the paper's span, interval and velocity, and for less."""
        tried = self.times[-1] <= 5400.0 and self.interval_min >= 3.0 and abs(self.injected_ft_per_s) <= 1500.0
        return 0.32 if tried else 0.0

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
        latitude = np.deg2rad(self.latitude_deg)
        north, up = self.earth_rate * np.cos(latitude), self.earth_rate * np.sin(latitude)
        return [c[0], c[1], 0.0, 0.0, 1.0, 0.0, north, up, 0.0, north, up]

    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """State: computed velocity (vx, vy); true up u and true Earth rate e in platform axes; c, the Earth rate as
        the computer believes, in computer axes."""
        (vx, vy), u, e, c = y[:2], y[2:5], y[5:8], y[8:11]
        ax, ay = self.acceleration(u, p)
        rate = self.platform_rate(y, p)
        coriolis = c[2] + c[2]
        x, y_ = self._transport(vx, vy)
        return [
            coriolis * vy + ax,
            ay - coriolis * vx,
            *_cross([ei - ri for ei, ri in zip(e, rate, strict=True)], u),
            *_cross(e, rate),
            -(y_ * c[2]),
            x * c[2],
            y_ * c[0] - x * c[1],
        ]

    def _transport(self, vx: Any, vy: Any) -> tuple[Any, Any]:
        """Rate over the spherical Earth about x and y, rad/s."""
        return vy * (-1.0 / self.earth_radius), vx * (1.0 / self.earth_radius)

    def platform_rate(self, y: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any, Any]:
        """How the platform turns in its own axes, rad/s: as commanded, and as the gyros drift."""
        dx, dy, dz, Dxx, Dxy, Dyx, Dyy = p[4:11]
        u, c = y[2:4], y[8:11]
        x, y_ = self._transport(y[0], y[1])
        return (
            Dxx * u[0] + (Dxy * u[1] + (c[0] + x + dx)),
            Dyx * u[0] + (Dyy * u[1] + (c[1] + y_ + dy)),
            c[2] + dz,
        )

    def acceleration(self, u: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        """What the accelerometers x and y show, m/s^2."""
        bx, by, kx, ky = p[:4]
        return (self.gravity + self.gravity * kx) * u[0] + bx, (self.gravity + self.gravity * ky) * u[1] + by

    @property
    def variation(self) -> Variation:
        """Deviations of v and c, and one small rotation f of the platform, which turns u and e alike:
        du = f x u, de = f x e; hence f' = f x w - dw with the platform's rate w. Eight numbers do for eleven."""

        def moved(y: Sequence[Any], d: Sequence[Any]) -> Sequence[Any]:
            return [*d[:2], *_cross(d[2:5], y[2:5]), *_cross(d[2:5], y[5:8]), *d[5:]]

        def slope(
            t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any], d: Sequence[Any], dp: Sequence[Any]
        ) -> Sequence[Any]:
            along = dict(zip([*y, *p], [*moved(y, d), *dp], strict=True))
            slopes, rate = self.rhs(t, y, p, c), self.platform_rate(y, p)
            turned = zip(_cross(d[2:5], rate), tangent(rate, along), strict=True)
            return [*tangent(slopes[:2], along), *(w - dw for w, dw in turned), *tangent(slopes[8:], along)]

        return Variation(8, slope, moved)

    def rate(self, p: Sequence[Any]) -> Any:
        """rad/s: Schuler rate with its scale factors, drifts with their g-terms, Earth, and what injected velocity and
        biases add over the span."""
        bx, by, kx, ky = p[:4]
        swing = np.sqrt(self.gravity / self.earth_radius * (1.0 + _length(kx, ky)))
        velocity = abs(self.injected_ft_per_s) * FOOT + _length(bx, by) * self.times[-1]
        return swing + _length(*p[4:7]) + _length(*p[7:11]) + (self.earth_rate + velocity * (1.0 / self.earth_radius))

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return y[0], y[1]

    def simulate_until(self, x: Array, stop: int) -> Array:
        return self._shown(x, stop, self.offset)

    @cached_property
    def offset(self) -> Array:
        """The velocities (m,) of the error-free system, which the read-out shows as well."""
        return self._shown(np.zeros((1, self.n)), len(self.times), self._zeros)[0]

    def linearization(self) -> Array:
        """H (m, n) as the paper builds it: the readings at one unit of each parameter, secants rather than slopes."""
        return np.ascontiguousarray(self.simulate(np.eye(self.n)).T)
