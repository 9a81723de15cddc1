"""Models the gimballed inertial navigation system (GINS) of the paper, section IV: 11 error
parameters, 240 velocities.

A stabilised platform on a stationary bench; axes x east, y north, z up at the start, spherical
Earth. An injected initial velocity error swings the platform at the Schuler
period, which makes scale-factor and mass-unbalance errors observable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import MinLen
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive
from ipe_bench.engine.equations import Equations, Variation
from ipe_bench.engine.integrator import Kernel
from ipe_bench.engine.tableaus import DOP853
from ipe_bench.engine.trace import tangent
from ipe_bench.measurements.base import Measurement, Parameter, UsualNoise, parameter_table
from ipe_bench.measurements.ode.model import OdeMeasurement

FOOT = 0.3048
"""Metres in a foot."""
_DEGREE_PER_HOUR = _ARCSEC = np.pi / 180 / 3600
_DIRECTIONS = 12
"""Directions of the injected velocities that a design chooses among, over the whole circle."""
_SENSED = 4
"""Further errors of the accelerometers."""
_CONSTANT = 7
"""These errors, and the three rotations of the platform."""


def _cross(a: Sequence[Any], b: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Computes a x b."""
    a1, a2, a3 = a
    b1, b2, b3 = b
    x = a2 * b3 - a3 * b2
    y = a3 * b1 - a1 * b3
    z = a1 * b2 - a2 * b1
    return x, y, z


def _length(*components: Any) -> Any:
    return np.sqrt(sum(v * v for v in components))


@dataclass(frozen=True)
class Gins(OdeMeasurement):
    """Simulates velocity errors of a gimballed INS over 90 minutes after an injected velocity, in
    four cases.

    Parameters, in multiples of the paper's Table 1: accelerometer biases, accelerometer
    scale-factor errors, gyro drifts, and gyro mass unbalances. Readings in m/s in C order over
    (case 4, time 30, axis 2), less the velocities of the error-free system, so h(0) = 0.

    `step` is the integration step in s; None chooses it for each trial by its parameters, so that
    the readings are within 1e-6 m/s to an error scale of 5000, and within 1.3e-6 at 10,000.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.measurements.Gins()
    >>> print(model.n, "parameters from", model.m, "velocities:", model.parameters[0].name, "...")
    11 parameters from 240 velocities: bx ...
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
    azimuth: Literal["wander", "north"] = "wander"
    """Whether the axes do not turn about up over the Earth, or keep north; the paper does not
    say."""

    reading_unit = "m/s"
    usual_noise = UsualNoise(step=0.02286)
    states = 11
    outputs = ("vx", "vy")

    tolerance = 1e-6
    shortest_step = 180.0 / 64

    @cached_property
    def trusted_angle(self) -> float:
        """0.32 for the paper's span, interval and velocities, and for less: of 9,000 draws, sparse
        and lopsided ones among them, the worst is off by 2.5e-8 m/s."""
        span_tried = self.times[-1] <= 5400.0 and self.interval_min >= 3.0
        velocity_tried = self._fastest <= 1500.0 * FOOT * (1 + 1e-9)
        return 0.32 if span_tried and velocity_tried else 0.0

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
        """m/s^2 for biases, 1 for scale factors, rad/s for drifts and for unbalances (per specific
        force in g)."""
        drift = _DEGREE_PER_HOUR
        si = {"g": self.gravity, "ppm": 1e-6, "deg/h": drift, "deg/h/g": drift}
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
        """Velocities in twelve directions, of the largest injected size and of half of it, and
        none; read twice as often. The cases of this set-up come first, under their own numbers."""
        top = self._fastest / FOOT
        turns = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        sizes = (top, top / 2)
        rays = [(size * np.cos(turn), size * np.sin(turn)) for size in sizes for turn in turns]
        rays.append((0.0, 0.0))
        injected = np.array(self.injected)[:, None]
        alike = np.isclose(rays, injected, atol=1e-6 * max(top, 1.0))
        here = alike.all(axis=2).any(axis=0)
        # Adding zero turns -0.0 into 0.0.
        new = [(round(x, 3) + 0.0, round(y, 3) + 0.0) for x, y in np.array(rays)[~here].tolist()]
        return replace(
            self,
            injected=(*self.injected, *new),
            interval_min=self.interval_min / 2,
            readings_per_case=2 * self.readings_per_case,
        )

    @property
    def entry_words(self) -> Mapping[str, Mapping[Any, str]]:
        """The injected velocity of each case."""
        cases = enumerate(self.injected, start=1)
        return {"case": {k: f"{x:.0f}, {y:.0f} ft/s" for k, (x, y) in cases}}

    def taking(self, rows: Sequence[int]) -> Measurement:
        """Restricts the model to the cases that the readings need."""
        each = 2 * self.readings_per_case
        cases = sorted({row // each for row in rows})
        fewer = replace(self, injected=tuple(self.injected[case] for case in cases))
        moved = [cases.index(row // each) * each + row % each for row in rows]
        return super(Gins, fewer).taking(moved)

    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """Levels the platform, and aligns it to the north, at the injected velocity."""
        latitude = np.deg2rad(self.latitude_deg)
        north = self.earth_rate * np.cos(latitude)
        up = self.earth_rate * np.sin(latitude)
        return [c[0], c[1], 0.0, 0.0, 1.0, 0.0, north, up, 0.0, north, up]

    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        """Computes the derivative of the state: computed velocity (vx, vy); true up u and true
        Earth rate e in platform axes; c, the Earth rate that the computer assumes, in computer
        axes."""
        vx, vy = y[:2]
        u = y[2:5]
        e = y[5:8]
        cx, cy, cz = y[8:11]
        ax, ay = self.acceleration(u, p)
        w = self.platform_rate(y, p)
        coriolis = cz + cz
        x, y_ = self._transport(vx, vy)
        # v' = a - (2 c + transport) x v; what the transport rate adds is vertical, and is not
        # computed.
        dvx = coriolis * vy + ax
        dvy = ay - coriolis * vx
        # Up is fixed to the Earth, e to the stars, and the platform turns by w: u' = (e - w) x u,
        # e' = e x w.
        du = _cross([ei - wi for ei, wi in zip(e, w, strict=True)], u)
        de = _cross(e, w)
        # The computer's axes turn by the transport rate: c' = c x (x, y, 0).
        dcx, dcy, dcz = -(y_ * cz), x * cz, y_ * cx - x * cy
        if self.azimuth == "north":
            # The transport rate has a third component: v' -= (0, 0, z) x v and c' += c x (0, 0, z).
            z = self._about_up(y)
            dvx += z * vy
            dvy -= z * vx
            dcx += z * cy
            dcy -= z * cx
        return [dvx, dvy, *du, *de, dcx, dcy, dcz]

    def _transport(self, vx: Any, vy: Any) -> tuple[Any, Any]:
        """Computes the rate over the spherical Earth about x and y, rad/s: -vy / R and vx / R."""
        x = vy * (-1.0 / self.earth_radius)
        y = vx * (1.0 / self.earth_radius)
        return x, y

    def _about_up(self, y: Sequence[Any]) -> Any:
        """Computes the rate at which axes that keep north turn about up, rad/s: vx tan(latitude) /
        R."""
        cx, cy, cz = y[8:11]
        return self._transport(y[0], y[1])[1] * cz / np.sqrt(cx * cx + cy * cy)

    def platform_rate(self, y: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any, Any]:
        """Computes the turn rate of the platform in its own axes, rad/s: the command plus the
        drifts of the gyros."""
        dx, dy, dz, Dxx, Dxy, Dyx, Dyy = p[4:11]
        ux, uy = y[2:4]
        cx, cy, cz = y[8:11]
        x, y_ = self._transport(y[0], y[1])
        # The command is the Earth rate and the transport rate; unbalances drift with the specific
        # force, in g.
        about_x = Dxx * ux + (Dxy * uy + (cx + x + dx))
        about_y = Dyx * ux + (Dyy * uy + (cy + y_ + dy))
        about_z = cz + dz
        if self.azimuth == "north":
            about_z += self._about_up(y)
        return about_x, about_y, about_z

    def acceleration(self, u: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        """Computes the output of the accelerometers x and y, m/s^2: g (1 + k) u + b."""
        bx, by, kx, ky = p[:4]
        g = self.gravity
        x = (g + g * kx) * u[0] + bx
        y = (g + g * ky) * u[1] + by
        return x, y

    @property
    def variation(self) -> Variation:
        """Deviations of v and c, and one small rotation f of the platform, which turns u and e
        alike: du = f x u, de = f x e; hence f' = f x w - dw with the platform's rate w. Eight
        numbers do for eleven."""

        def moved(y: Sequence[Any], d: Sequence[Any]) -> Sequence[Any]:
            f = d[2:5]
            return [*d[:2], *_cross(f, y[2:5]), *_cross(f, y[5:8]), *d[5:]]

        def slope(t: Any, y: Any, p: Any, c: Any, d: Any, dp: Any) -> Sequence[Any]:
            along = dict(zip([*y, *p], [*moved(y, d), *dp], strict=True))
            slopes = self.rhs(t, y, p, c)
            w = self.platform_rate(y, p)
            turned = _cross(d[2:5], w)
            dw = tangent(w, along)
            dv = tangent(slopes[:2], along)
            df = [fi - dwi for fi, dwi in zip(turned, dw, strict=True)]
            return [*dv, *df, *tangent(slopes[8:], along)]

        return Variation(8, slope, moved)

    def fastest_rate(self, p: Sequence[Any]) -> Any:
        """Bounds the rate in rad/s: Schuler rate with scale factors, drifts with g-terms, Earth,
        injected velocity and biases."""
        bx, by, kx, ky = p[:4]
        # The Schuler rate is sqrt(g / R).
        swing = np.sqrt(self.gravity / self.earth_radius * (1.0 + _length(kx, ky)))
        velocity = self._fastest + _length(bx, by) * self.times[-1]
        with_gyros = swing + _length(*p[4:7]) + _length(*p[7:11])
        return with_gyros + (self.earth_rate + velocity * (1.0 / self.earth_radius))

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return y[0], y[1]

    @property
    def _origin(self) -> Array:
        return self.offset

    @cached_property
    def offset(self) -> Array:
        """The velocities (m,) of the error-free system, which the read-out shows as well."""
        free_of_errors = np.zeros((1, self.n))
        return self._shown(free_of_errors, len(self.times), self._zeros)[0]

    def linearization(self) -> Array:
        """Builds H (m, n) as the paper does: the readings at one unit of each parameter, secants
        rather than slopes."""
        return np.ascontiguousarray(self.simulate(np.eye(self.n)).T)


@dataclass(frozen=True)
class RicherGins(Gins):
    """Adds errors to the eleven parameters of `Gins`, each drawn anew in every trial from N(0,
    deviation^2) at any error scale: a truth to measure model mismatch with. For x of eleven columns
    it is `Gins`.

    Random walk of the drifts: each reading interval of each case begins with an independent
    increment of deviation `gyro_random_walk` times the root of the interval, and the drift is
    constant within it.

    Example, in which a misaligned platform stays undetected:

    >>> import ipe_bench as ib
    >>> plain = ib.measurements.Gins()
    >>> misaligned = ib.measurements.RicherGins(platform_misalignment=5.0)
    >>> bench = ib.Scenario(plain, truth=misaligned)
    >>> row = ib.run(bench, {"gn": ib.baselines.GaussNewton()}, trials=5).iloc[-1]
    >>> print(row["error_median"] > 10, row["misfit"])
    True 0.0
    """

    gyro_random_walk: NonNegative = 0.0
    """Random walk of each drift, deg/h per root hour."""
    accelerometer_quadratic: NonNegative = 0.0
    """Output that grows with the square of the specific force along each level axis, micro-g per
    g^2."""
    accelerometer_misalignment: NonNegative = 0.0
    """Angle by which each level accelerometer senses the other level axis, arc seconds. Sensing the
    vertical axis would be a bias, which the model has."""
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
        """Per trial: 2 quadratic coefficients in 1 / (m/s^2), 2 misalignments and 3 rotations in
        rad, then the increments of dx, dy, dz in rad/s in C order over (case, interval, axis)."""
        # A random walk grows with the root of the time, in hours.
        step = self.gyro_random_walk * self._drift * np.sqrt(self.interval_min / 60.0)
        deviation = [
            self.accelerometer_quadratic * 1e-6 / self.gravity,
            self.accelerometer_misalignment * _ARCSEC,
            self.platform_misalignment * _ARCSEC,
            step,
        ]
        steps = len(self.cases) * self.readings_per_case * 3
        return np.repeat(deviation, [2, 2, 3, steps])

    @property
    def _drift(self) -> float:
        """The rad/s in a deg/h, as the parameters have them."""
        return self.si_sizes[4] / self.parameters[4].size

    @property
    def nuisances(self) -> tuple[Parameter, ...]:
        """Nuisances in the units of the options that set their deviations; the walk's increments in
        deg/h."""
        quadratic = self.gravity / 1e-6
        angle = 1 / _ARCSEC
        cases = range(1, len(self.cases) + 1)
        intervals = range(1, self.readings_per_case + 1)
        walk = [f"walk d{axis} {case}.{k}" for case, k, axis in product(cases, intervals, "xyz")]
        return parameter_table(
            (("quadratic x", "quadratic y"), "micro-g/g^2", quadratic, "accelerometer quadratic"),
            (("misalignment xy", "misalignment yx"), "arcsec", angle, "accelerometer misalignment"),
            (("platform x", "platform y", "platform z"), "arcsec", angle, "platform misalignment"),
            (walk, "deg/h", 1 / self._drift, "gyro random walk"),
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
            return
        stop = z.shape[1] // (2 * len(self.cases))
        z[rows] = self._walked(x[rows], steps, stop) - offset[self.rows(stop)]

    def _rates(self, x: Array) -> Array:
        """Computes the rates with the farthest walk of the drifts; such a trial is tested at any
        rate of turn."""
        if x.shape[1] == self.n:
            return super()._rates(x)
        walk = np.abs(self._walk(x)).reshape(len(x), -1).max(axis=1)
        parameters = np.ascontiguousarray(x[:, : self.n])
        # A vector whose three components are at most w is at most sqrt(3) w long.
        rates = super()._rates(parameters) + np.sqrt(3.0) * walk
        beyond = np.nextafter(self.trusted_angle / self._longest, np.inf)
        return np.maximum(rates, beyond)

    def _walk(self, x: Array) -> Array:
        """Computes the walk of the drifts: (trials x cases, intervals, axes) in rad/s."""
        increments = x[:, self.n + _CONSTANT :]
        return np.cumsum(increments.reshape(len(x) * len(self.cases), -1, 3), axis=1)

    def _walked(self, x: Array, steps: NDArray[np.int64], stop: int) -> Array:
        """Integrates from reading to reading, with the drifts of each interval: (trials,
        readings)."""
        n = self.n
        cases = len(self.cases)
        walk = self._walk(x)
        further = x[:, n : n + _CONSTANT]
        constant = np.concatenate([x[:, :n] * self.si_sizes, further], axis=1)
        p = np.repeat(constant, cases, axis=0)
        errors = p[:, : n + _SENSED]
        y = self._tilted(p, np.tile(self.cases, (len(x), 1)))
        trials = np.arange(len(p))
        interval = np.array([60.0 * self.interval_min])
        z = np.empty((len(p), stop, 2))
        for k in range(stop):
            # The state at the start of the interval is an argument beside the parameters.
            inputs = np.concatenate([errors, y], axis=1)
            inputs[:, 4:7] += walk[:, k]  # dx, dy, dz
            sizes = np.ones(inputs.shape[1])
            # The right-hand side does not depend on time, so every interval may begin at 0.
            given = (inputs, sizes, np.zeros((1, 0)), trials, interval, steps[k : k + 1])
            self._motion.run(*given, np.zeros(self.states), y.reshape(-1))
            z[:, k] = y[:, :2]
        return z.reshape(len(x), cases * stop * 2)

    def acceleration(self, u: Sequence[Any], p: Sequence[Any]) -> tuple[Any, Any]:
        """Computes the acceleration with the errors of the accelerometers, if they stand behind the
        parameters."""
        if len(p) == self.n:
            return super().acceleration(u, p)
        bx, by, kx, ky = p[:4]
        qx, qy, mxy, myx = p[11:15]
        fx = self.gravity * u[0]
        fy = self.gravity * u[1]
        # Each output is (1 + k) (f + q f^2 + m times the other force) + b.
        x = fx + qx * fx * fx + mxy * fy
        y = fy + qy * fy * fy + myx * fx
        ax = (1.0 + kx) * x + bx
        ay = (1.0 + ky) * y + by
        return ax, ay

    def _tilted(self, p: Array, c: Array) -> Array:
        """Turns the platform about x, then y, then z: true up and Earth axis turn the other way in
        its axes."""
        y = self.start(list(p.T), list(c.T))
        turns = list(p[:, self.n + _SENSED :].T)
        u = _turned(y[2:5], turns)
        e = _turned(y[5:8], turns)
        state = [*y[:2], *u, *e, *y[8:11]]
        return np.stack([np.broadcast_to(v, len(p)) for v in state], axis=1)

    @cached_property
    def _motion(self) -> Kernel:
        """Equations between readings: the parameters, the accelerometers' errors and the state are
        arguments."""
        states = self.states
        given = self.n + _SENSED

        arithmetic = (lambda p, c: p[given:]), self.rhs, (lambda t, y, p, c: y)
        return Kernel(Equations(states, given + states, 0, states, *arithmetic), DOP853)


def _turned(v: Sequence[Any], angles: Sequence[NDArray[Any]]) -> list[Any]:
    """Turns a fixed vector into axes that turn by the angles about x, then y, then z."""
    a, b, c = v
    about_x, about_y, about_z = angles
    b, c = _in_turned_axes(b, c, about_x)
    c, a = _in_turned_axes(c, a, about_y)
    a, b = _in_turned_axes(a, b, about_z)
    return [a, b, c]


def _in_turned_axes(first: Any, second: Any, angle: NDArray[Any]) -> tuple[Any, Any]:
    """Computes two components in axes that have turned by an angle from the first towards the
    second."""
    cos = np.cos(angle)
    sin = np.sin(angle)
    along = cos * first + sin * second
    across = cos * second - sin * first
    return along, across
