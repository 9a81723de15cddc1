"""Models the gimballed inertial navigation system (GINS) of the paper, section IV: 11 error parameters, 240 velocities.

A stabilised platform on a stationary bench; axes x east, y north, z up at the start, wander azimuth, spherical Earth.
An injected initial velocity error swings the platform at the Schuler period, which makes scale-factor and
mass-unbalance errors observable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import MinLen
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive
from ipe_bench.engine.integrator import Kernel
from ipe_bench.engine.plan import DOP853, Equations, Variation
from ipe_bench.engine.trace import tangent
from ipe_bench.measurements.base import Measurement, Parameter, UsualNoise, parameter_table
from ipe_bench.measurements.ode.model import OdeMeasurement

FOOT = 0.3048
"""Metres in a foot."""
_DEGREE_PER_HOUR = _ARCSEC = np.pi / 180 / 3600
_DIRECTIONS = 12
"""Directions of the injected velocities that a design chooses among, over the whole circle."""
_SENSED, _CONSTANT = 4, 7
"""Further errors of the accelerometers, and with them the three rotations of the platform."""


def _cross(a: Sequence[Any], b: Sequence[Any]) -> tuple[Any, Any, Any]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _length(*components: Any) -> Any:
    return np.sqrt(sum(v * v for v in components))


@dataclass(frozen=True)
class Gins(OdeMeasurement):
    """Simulates velocity errors of a gimballed INS over 90 minutes after an injected velocity, in four cases.

    Parameters, in multiples of the paper's Table 1: accelerometer biases, accelerometer scale-factor errors, gyro
    drifts, and gyro mass unbalances. Readings in m/s in C order over (case 4, time 30, axis 2), less the velocities of
    the error-free system, so h(0) = 0.

    `step` is the integration step in s; None chooses it for each trial by its parameters, so that the readings are
    within 1e-6 m/s to an error scale of 5000, and within 1.3e-6 at 10,000.
    """

    latitude_deg: float = 36.35
    earth_radius: float = 6378137.0
    gravity: float = 9.80665
    earth_rate: float = 7.292115e-5
    injected: Annotated[tuple[tuple[Finite, Finite], ...], MinLen(1)] = (
        *((1500.0, 0.0), (0.0, 1500.0)),
        *((-1500.0, 0.0), (0.0, -1500.0)),
    )
    """Velocities (x, y) in ft/s to inject, a case each."""
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
        """0.32 for the paper's span, interval and velocities, and for less: of 9,000 draws, sparse and lopsided ones
        among them, the worst is off by 2.5e-8 m/s."""
        tried = (
            self.times[-1] <= 5400.0
            and self.interval_min >= 3.0
            and self._fastest <= 1500.0 * FOOT * (1 + 1e-9)
        )
        return 0.32 if tried else 0.0

    @cached_property
    def _fastest(self) -> float:
        """The largest injected velocity, m/s."""
        return float(np.hypot(*self.cases.T).max())

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return parameter_table(
            (("bx", "by"), "g", 1e-4, "accelerometer bias"),
            (("kx", "ky"), "ppm", 100.0, "accelerometer scale factor"),
            (("dx", "dy"), "deg/h", 0.01, "gyro drift x, y"),
            (("dz",), "deg/h", 0.1, "gyro drift z"),
            (("Dxx", "Dxy", "Dyx", "Dyy"), "deg/h/g", 0.2, "gyro mass unbalance"),
        )

    @cached_property
    def si_sizes(self) -> Array:
        """m/s^2 for biases, 1 for scale factors, rad/s for drifts and for unbalances (per specific force in g)."""
        si = {
            "g": self.gravity,
            "ppm": 1e-6,
            "deg/h": _DEGREE_PER_HOUR,
            "deg/h/g": _DEGREE_PER_HOUR,
        }
        return np.array([p.size * si[p.unit] for p in self.parameters])

    @cached_property
    def times(self) -> Array:
        return 60.0 * self.interval_min * np.arange(1, self.readings_per_case + 1)

    @cached_property
    def cases(self) -> Array:
        """Injected velocity (x, y) in m/s."""
        return FOOT * np.array(self.injected)

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
        rays = [
            (size * np.cos(turn), size * np.sin(turn)) for size in (top, top / 2) for turn in turns
        ] + [(0.0, 0.0)]
        here = np.isclose(rays, np.array(self.injected)[:, None], atol=1e-6 * max(top, 1.0)).all(
            axis=2
        )
        new = [
            (round(x, 3) + 0.0, round(y, 3) + 0.0)
            for x, y in np.array(rays)[~here.any(axis=0)].tolist()
        ]
        often = {
            "interval_min": self.interval_min / 2,
            "readings_per_case": 2 * self.readings_per_case,
        }
        return replace(self, injected=(*self.injected, *new), **often)

    @property
    def entry_words(self) -> Mapping[str, Mapping[Any, str]]:
        """The injected velocity of each case."""
        return {
            "case": {k: f"{x:.0f}, {y:.0f} ft/s" for k, (x, y) in enumerate(self.injected, start=1)}
        }

    def taking(self, rows: Sequence[int]) -> Measurement:
        """Restricts the model to the cases that the readings need."""
        each = 2 * self.readings_per_case
        cases = sorted({row // each for row in rows})
        fewer = replace(self, injected=tuple(self.injected[case] for case in cases))
        return super(Gins, fewer).taking(
            [cases.index(row // each) * each + row % each for row in rows]
        )

    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        latitude = np.deg2rad(self.latitude_deg)
        north, up = self.earth_rate * np.cos(latitude), self.earth_rate * np.sin(latitude)
        return [c[0], c[1], 0.0, 0.0, 1.0, 0.0, north, up, 0.0, north, up]

    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """Computes the derivative of the state: computed velocity (vx, vy); true up u and true Earth rate e in platform
        axes; c, the Earth rate that the computer assumes, in computer axes."""
        (vx, vy), u, e, c = y[:2], y[2:5], y[5:8], y[8:11]
        (ax, ay), rate, coriolis = self.acceleration(u, p), self.platform_rate(y, p), c[2] + c[2]
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
        """Computes the rate over the spherical Earth about x and y, rad/s."""
        return vy * (-1.0 / self.earth_radius), vx * (1.0 / self.earth_radius)

    def platform_rate(self, y: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any, Any]:
        """Computes the turn rate of the platform in its own axes, rad/s: the command plus the drifts of the gyros."""
        dx, dy, dz, Dxx, Dxy, Dyx, Dyy = p[4:11]
        u, c = y[2:4], y[8:11]
        x, y_ = self._transport(y[0], y[1])
        about_x = Dxx * u[0] + (Dxy * u[1] + (c[0] + x + dx))
        return about_x, Dyx * u[0] + (Dyy * u[1] + (c[1] + y_ + dy)), c[2] + dz

    def acceleration(self, u: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        """Computes the output of the accelerometers x and y, m/s^2."""
        bx, by, kx, ky = p[:4]
        return (self.gravity + self.gravity * kx) * u[0] + bx, (
            self.gravity + self.gravity * ky
        ) * u[1] + by

    @property
    def variation(self) -> Variation:
        """Deviations of v and c, and one small rotation f of the platform, which turns u and e alike:
        du = f x u, de = f x e; hence f' = f x w - dw with the platform's rate w. Eight numbers do for eleven."""

        def moved(y: Sequence[Any], d: Sequence[Any]) -> Sequence[Any]:
            return [*d[:2], *_cross(d[2:5], y[2:5]), *_cross(d[2:5], y[5:8]), *d[5:]]

        def slope(t: Any, y: Any, p: Any, c: Any, d: Any, dp: Any) -> Sequence[Any]:
            along = dict(zip([*y, *p], [*moved(y, d), *dp], strict=True))
            slopes, rate = self.rhs(t, y, p, c), self.platform_rate(y, p)
            turned = zip(_cross(d[2:5], rate), tangent(rate, along), strict=True)
            return [
                *tangent(slopes[:2], along),
                *(w - dw for w, dw in turned),
                *tangent(slopes[8:], along),
            ]

        return Variation(8, slope, moved)

    def fastest_rate(self, p: Sequence[Any]) -> Any:
        """Bounds the rate in rad/s: Schuler rate with scale factors, drifts with g-terms, Earth, injected velocity and
        biases."""
        bx, by, kx, ky = p[:4]
        swing = np.sqrt(self.gravity / self.earth_radius * (1.0 + _length(kx, ky)))
        velocity = self._fastest + _length(bx, by) * self.times[-1]
        return (
            swing
            + _length(*p[4:7])
            + _length(*p[7:11])
            + (self.earth_rate + velocity * (1.0 / self.earth_radius))
        )

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
        """Builds H (m, n) as the paper does: the readings at one unit of each parameter, secants rather than slopes."""
        return np.ascontiguousarray(self.simulate(np.eye(self.n)).T)


@dataclass(frozen=True)
class RicherGins(Gins):
    """Adds errors to the eleven parameters of `Gins`, each drawn anew in every trial from N(0, deviation^2) at any
    error scale: a truth to measure model mismatch with. For x of eleven columns it is `Gins`.

    Random walk of the drifts: each reading interval of each case begins with an independent increment of deviation
    `gyro_random_walk` times the root of the interval, and the drift is constant within it.
    """

    gyro_random_walk: NonNegative = 0.0
    """Random walk of each drift, deg/h per root hour."""
    accelerometer_quadratic: NonNegative = 0.0
    """Output that grows with the square of the specific force along each level axis, micro-g per g^2."""
    accelerometer_misalignment: NonNegative = 0.0
    """Angle by which each level accelerometer senses the other level axis, arc seconds. Sensing the vertical axis would
    be a bias, which the model has."""
    platform_misalignment: NonNegative = 0.0
    """Initial rotation of the platform about each of its axes, arc seconds."""

    name = "gins_richer"
    option_units: ClassVar[Mapping[str, str]] = {
        "gyro_random_walk": "deg/h/√h",
        "accelerometer_quadratic": "µg/g²",
        "accelerometer_misalignment": "arc seconds",
        "platform_misalignment": "arc seconds",
    }

    @cached_property
    def nuisance_deviation(self) -> Array:
        """Per trial: 2 quadratic coefficients in 1 / (m/s^2), 2 misalignments and 3 rotations in rad, then the
        increments of dx, dy, dz in rad/s in C order over (case, interval, axis)."""
        deviation = [
            self.accelerometer_quadratic * 1e-6 / self.gravity,
            self.accelerometer_misalignment * _ARCSEC,
            self.platform_misalignment * _ARCSEC,
            self.gyro_random_walk * self._drift * np.sqrt(self.interval_min / 60.0),
        ]
        return np.repeat(deviation, [2, 2, 3, len(self.cases) * self.readings_per_case * 3])

    @property
    def _drift(self) -> float:
        """The rad/s in a deg/h, as the parameters have them."""
        return self.si_sizes[4] / self.parameters[4].size

    @property
    def nuisances(self) -> tuple[Parameter, ...]:
        """Nuisances in the units of the options that set their deviations; the walk's increments in deg/h."""
        steps = product(range(1, len(self.cases) + 1), range(1, self.readings_per_case + 1), "xyz")
        return parameter_table(
            (
                ("quadratic x", "quadratic y"),
                "micro-g/g^2",
                self.gravity / 1e-6,
                "accelerometer quadratic",
            ),
            (
                ("misalignment xy", "misalignment yx"),
                "arcsec",
                1 / _ARCSEC,
                "accelerometer misalignment",
            ),
            (("tilt x", "tilt y", "tilt z"), "arcsec", 1 / _ARCSEC, "platform tilt"),
            (
                [f"walk d{a} {case}.{k}" for case, k, a in steps],
                "deg/h",
                1 / self._drift,
                "gyro random walk",
            ),
        )

    def _simulate(
        self,
        x: Array,
        rows: NDArray[np.intp],
        steps: NDArray[np.int64],
        offset: Array,
        z: Array,
        y: Array | None = None,
    ) -> None:
        if x.shape[1] == self.n:
            super()._simulate(x, rows, steps, offset, z, y)
        else:
            stop = z.shape[1] // (2 * len(self.cases))
            z[rows] = self._walked(x[rows], steps, stop) - offset[self.rows(stop)]

    def _rates(self, x: Array) -> Array:
        """Computes the rates with the farthest walk of the drifts; such a trial is tested at any rate of turn."""
        if x.shape[1] == self.n:
            return super()._rates(x)
        walk = np.abs(self._walk(x)).reshape(len(x), -1).max(axis=1)
        rates = super()._rates(np.ascontiguousarray(x[:, : self.n])) + np.sqrt(3.0) * walk
        return np.maximum(rates, np.nextafter(self.trusted_angle / self._longest, np.inf))

    def _walk(self, x: Array) -> Array:
        """Computes the walk of the drifts: (trials x cases, intervals, axes) in rad/s."""
        return np.cumsum(
            x[:, self.n + _CONSTANT :].reshape(len(x) * len(self.cases), -1, 3), axis=1
        )

    def _walked(self, x: Array, steps: NDArray[np.int64], stop: int) -> Array:
        """Integrates from reading to reading, with the drifts of each interval: (trials, readings)."""
        walk, cases = self._walk(x), len(self.cases)
        constant = np.concatenate(
            [x[:, : self.n] * self.si_sizes, x[:, self.n : self.n + _CONSTANT]], axis=1
        )
        p = np.repeat(constant, cases, axis=0)
        y = self._tilted(p, np.tile(self.cases, (len(x), 1)))
        interval = np.array([60.0 * self.interval_min])
        z = np.empty((len(p), stop, 2))
        for k in range(stop):
            inputs = np.concatenate([p[:, : self.n + _SENSED], y], axis=1)
            inputs[:, 4:7] += walk[:, k]  # dx, dy, dz
            # The right-hand side does not depend on time, so every interval may begin at 0.
            given = (
                inputs,
                np.ones(inputs.shape[1]),
                np.zeros((1, 0)),
                np.arange(len(p)),
                interval,
                steps[k : k + 1],
            )
            self._motion.run(*given, np.zeros(self.states), y.reshape(-1))
            z[:, k] = y[:, :2]
        return z.reshape(len(x), cases * stop * 2)

    def acceleration(self, u: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        """Computes the acceleration with the errors of the accelerometers, if they stand behind the parameters."""
        if len(p) == self.n:
            return super().acceleration(u, p)
        bx, by, kx, ky = p[:4]
        qx, qy, mxy, myx = p[11:15]
        fx, fy = self.gravity * u[0], self.gravity * u[1]
        x, y = fx + qx * fx * fx + mxy * fy, fy + qy * fy * fy + myx * fx
        return (1.0 + kx) * x + bx, (1.0 + ky) * y + by

    def _tilted(self, p: Array, c: Array) -> Array:
        """Turns the platform about x, then y, then z: true up and Earth axis turn the other way in its axes."""
        y = self.start(list(p.T), list(c.T))
        turns = list(p[:, self.n + _SENSED :].T)
        y = [*y[:2], *_turned(y[2:5], turns), *_turned(y[5:8], turns), *y[8:11]]
        return np.stack([np.broadcast_to(v, len(p)) for v in y], axis=1)

    @cached_property
    def _motion(self) -> Kernel:
        """Equations between readings: the parameters, the accelerometers' errors and the state are arguments."""
        given = self.n + _SENSED

        arithmetic = (lambda p, c: p[given:]), self.rhs, (lambda t, y, p, c: y)
        return Kernel(
            Equations(self.states, given + self.states, 0, self.states, *arithmetic), DOP853
        )


def _turned(v: Sequence[Any], angles: Sequence[NDArray[Any]]) -> list[Any]:
    """Turns a fixed vector into axes that turn by the angles about x, then y, then z."""
    a, b, c = v
    x, y, z = angles
    b, c = np.cos(x) * b + np.sin(x) * c, np.cos(x) * c - np.sin(x) * b
    c, a = np.cos(y) * c + np.sin(y) * a, np.cos(y) * a - np.sin(y) * c
    a, b = np.cos(z) * a + np.sin(z) * b, np.cos(z) * b - np.sin(z) * a
    return [a, b, c]
