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

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite, Positive
from ipe_bench.measurements.base import Measurement, Parameter, UsualNoise
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.measurements.ode.plan import Variation
from ipe_bench.measurements.ode.trace import tangent

FOOT = 0.3048
"""Metres in a foot."""
_DEGREE_PER_HOUR = np.pi / 180 / 3600
_DIRECTIONS = 12
"""Directions of the injected velocities that a design chooses among, over the whole circle."""


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
    injected: tuple[tuple[Finite, Finite], ...] | None = None
    """Velocities (x, y) in ft/s to inject, a case each; None: the paper's four cases of `injected_ft_per_s`."""

    reading_unit = "m/s"
    usual_noise = UsualNoise(step=0.02286)
    states = 11
    outputs = ("vx", "vy")

    tolerance = 1e-6
    shortest_step = 180.0 / 64

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.injected is not None and not self.injected:
            raise UserError("injected=[]: give at least one velocity, such as [[1500, 0]], or null")

    @cached_property
    def trusted_angle(self) -> float:
        """Of 9,000 draws at 0.32, sparse and lopsided ones among them, the worst is off by 2.5e-8 m/s; that holds for
        the paper's span, interval and velocities, and for less; in other directions the worst of 9,000 is 2.5e-8 too.
        """
        tried = self.times[-1] <= 5400.0 and self.interval_min >= 3.0 and self._fastest <= 1500.0 * FOOT * (1 + 1e-9)
        return 0.32 if tried else 0.0

    @cached_property
    def _fastest(self) -> float:
        """The largest injected velocity, m/s."""
        return float(np.hypot(*self.cases.T).max())

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
        """Injected velocity (x, y) in m/s: along x, along y, against x, against y, unless `injected` says otherwise."""
        if self.injected is not None:
            return FOOT * np.array(self.injected)
        return self.injected_ft_per_s * FOOT * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        columns = super().index
        minutes = [round(t / 60.0, 6) for t in columns["time [s]"]]
        return {"case": columns["case"], "time [min]": minutes, "axis": columns["output"]}

    @property
    def candidates(self) -> Measurement:
        """Velocities in twelve directions, of the largest injected size and of half of it, and none; read twice as
        often. The cases of this set-up come first, under their own numbers."""
        top = self._fastest / FOOT
        turns = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        rays = [(size * np.cos(turn), size * np.sin(turn)) for size in (top, top / 2) for turn in turns]
        here = [(float(x), float(y)) for x, y in self.cases / FOOT]
        new = [v for v in [*rays, (0.0, 0.0)] if not np.isclose(v, here, atol=1e-6 * max(top, 1.0)).all(axis=1).any()]
        injected = (*here, *((round(float(x), 3) + 0.0, round(float(y), 3) + 0.0) for x, y in new))
        return replace(
            self, injected=injected, interval_min=self.interval_min / 2, readings_per_case=2 * self.readings_per_case
        )

    @property
    def levels(self) -> Mapping[str, Mapping[Any, str]]:
        """The injected velocity of each case."""
        return {"case": {k: f"{x:.0f}, {y:.0f} ft/s" for k, (x, y) in enumerate(self.cases / FOOT, start=1)}}

    def taking(self, rows: Sequence[int]) -> Measurement:
        """Only the cases that are needed are computed; whole cases read at even intervals are this model with other
        options."""
        taken = np.zeros((len(self.cases), self.readings_per_case, 2), dtype=bool)
        taken.reshape(-1)[list(rows)] = True
        cases, read = np.flatnonzero(taken.any(axis=(1, 2))), np.flatnonzero(taken.any(axis=(0, 2)))
        fewer = replace(self, injected=tuple((float(x), float(y)) for x, y in self.cases[cases] / FOOT))
        plain = replace(self, injected=None)
        if len(cases) == len(plain.cases) and np.allclose(fewer.cases, plain.cases):
            fewer = plain
        every = int(read[0]) + 1
        if taken[np.ix_(cases, read)].all() and np.array_equal(read, every * np.arange(1, len(read) + 1) - 1):
            return replace(fewer, interval_min=every * self.interval_min, readings_per_case=len(read))
        return super(Gins, fewer).taking(np.flatnonzero(taken[cases]).tolist())

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

    def fastest_rate(self, p: Sequence[Any]) -> Any:
        """rad/s: Schuler rate with its scale factors, drifts with their g-terms, Earth, and what injected velocity and
        biases add over the span."""
        bx, by, kx, ky = p[:4]
        swing = np.sqrt(self.gravity / self.earth_radius * (1.0 + _length(kx, ky)))
        velocity = self._fastest + _length(bx, by) * self.times[-1]
        return swing + _length(*p[4:7]) + _length(*p[7:11]) + (self.earth_rate + velocity * (1.0 / self.earth_radius))

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return y[0], y[1]

    @property
    def _origin(self) -> Array:
        return self.offset

    @cached_property
    def offset(self) -> Array:
        """The velocities (m,) of the error-free system, which the read-out shows as well."""
        return self._shown(np.zeros((1, self.n)), len(self.times), self._zeros)[0]

    def linearization(self) -> Array:
        """H (m, n) as the paper builds it: the readings at one unit of each parameter, secants rather than slopes."""
        return np.ascontiguousarray(self.simulate(np.eye(self.n)).T)
