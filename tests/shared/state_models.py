"""Models of the literature in Python: what those of conf/state_model, by formulas, are held
against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive
from ipe_bench.measurements import Parameter
from ipe_bench.states import Formulas, Normal, StateModel
from ipe_bench.states.algebra import mahalanobis, root


def white_acceleration(step: float, density: float) -> Array:
    """Covariance (2, 2) that a white acceleration of this density adds to position and velocity in
    `step` seconds."""
    return density * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])


SQUARE = Formulas(
    next={"x": "0.95*x + w"},
    readings={"z": "x**2"},
    noise={"w": 0.3},
    deviation={"z": 0.3},
    start={"x": 0.5},
    spread={"x": 1.0},
    count=12,
)
"""A state that is read by its square, which leaves the sign open."""


def straight_line(spread: float, deviation: float) -> Formulas:
    """A line through ten readings, of whose value and slope the prior says so much."""
    return Formulas(
        next={"p": "p + v", "v": "v"},
        readings={"z": "p"},
        deviation={"z": deviation},
        spread={"p": spread, "v": spread},
        count=10,
    )


def path_cost(model: StateModel, z: Array, start: Array, mean: Array) -> Array:
    """-2 log p(path | readings) (trials,) up to a constant, of a path that begins at `start`
    (trials, n) before the first transition; infinite where a step lies outside the range of its
    noise."""
    total, before = mahalanobis(start - model.prior.mean, model.prior.covariance), start
    for k in range(model.epochs):
        if model.moves(k):
            total = total + mahalanobis(mean[:, k] - model.transition(before, k), model.Q(k))
        seen = np.isfinite(z[:, k])
        e = np.where(seen, z[:, k] - model.observe(mean[:, k], k), 0.0)
        for i, there in enumerate(seen):
            R = model.R(k)[np.ix_(there, there)]
            total[i] = total[i] + e[i, there] @ np.linalg.solve(R, e[i, there])
        before = mean[:, k]
    return total


@dataclass(frozen=True)
class Steady(StateModel):
    """A model read at even steps, the first of them a step after the prior."""

    count: Count = 100
    """K, the number of epochs."""
    step: Positive = 1.0
    """Seconds between epochs."""

    @property
    def times(self) -> Array:
        return self.step * np.arange(1, self.count + 1)


@dataclass(frozen=True)
class CoordinatedTurn(Steady):
    """An aircraft that turns at an unknown rate, seen by range and bearing (Arasaratnam and Haykin,
    IEEE TAC 54, 2009, section VI.B)."""

    density: NonNegative = 0.1
    """Spectral density of the accelerations, m^2/s^3."""
    walk: NonNegative = 1.75e-4
    """Variance that the turn rate gains in a second, rad^2/s^3."""
    range_deviation: Positive = 10.0
    """Standard deviation of a range, m."""
    bearing_variance: Positive = 1e-5
    """Of a bearing, rad^2."""

    @property
    def states(self) -> tuple[Parameter, ...]:
        units = {"x": "m", "vx": "m/s", "y": "m", "vy": "m/s", "rate": "rad/s"}
        return tuple(Parameter(name, unit) for name, unit in units.items())

    @property
    def periods(self) -> tuple[float, ...]:
        return (0.0, 2 * np.pi)

    @property
    def prior(self) -> Normal:
        mean = np.array([1000.0, 300.0, 1000.0, 0.0, np.radians(-3.0)])
        return Normal(mean, np.diag([100.0, 10.0, 100.0, 10.0, 1e-4]))

    def transition(self, x: Array, k: int) -> Array:
        px, vx, py, vy, rate = np.moveaxis(x, -1, 0)
        rate = np.where(np.abs(rate) < 1e-9, 1e-9, rate)
        s, c = np.sin(rate * self.step), np.cos(rate * self.step)
        a, b = s / rate, (1 - c) / rate
        moved = [
            px + a * vx - b * vy,
            c * vx - s * vy,
            py + b * vx + a * vy,
            s * vx + c * vy,
            x[..., 4],
        ]
        return np.stack(moved, axis=-1)

    def observe(self, x: Array, k: int) -> Array:
        px, py = x[..., 0], x[..., 2]
        return np.stack([np.sqrt(px * px + py * py), bearing(px, py)], axis=-1)

    def gain(self, k: int) -> Array:
        G = np.zeros((5, 5))
        block = root(white_acceleration(self.step, self.density))
        columns = block.shape[1]
        G[:2, :columns], G[2:4, 2 : 2 + columns], G[4, 4] = (
            block,
            block,
            np.sqrt(self.walk * self.step),
        )
        return G

    def R(self, k: int) -> Array:
        return np.diag([self.range_deviation**2, self.bearing_variance])


def bearing(x: Array, y: Array) -> Array:
    """The angle of (x, y) from the x axis in rad, for real or complex-step arguments."""
    if not np.iscomplexobj(x):
        return np.arctan2(y, x)
    a, b = np.real(x), np.real(y)
    return np.arctan2(b, a) + 1j * (a * np.imag(y) - b * np.imag(x)) / (a**2 + b**2)


@dataclass(frozen=True)
class Pendulum(Steady):
    """Angle and rate of a pendulum pushed by white noise, seen by the sine of the angle (Särkkä and
    Svensson, Bayesian Filtering and Smoothing, 2nd ed., 2023, examples 3.7 and 4.6)."""

    count: Count = 500
    step: Positive = 0.01
    gravity: Finite = 9.81
    """Gravity over length, 1/s^2."""
    density: NonNegative = 0.01
    """Spectral density of the angular acceleration, rad^2/s^3."""
    variance: Positive = 0.1
    """Of a reading."""
    start: tuple[Finite, Finite] = (0.0, 0.0)
    """Mean of the prior: angle in rad and rate in rad/s."""
    spread: Positive = 1.0
    """Standard deviation of the prior, in rad and in rad/s."""

    @property
    def states(self) -> tuple[Parameter, ...]:
        return Parameter("angle", "rad"), Parameter("rate", "rad/s")

    @property
    def prior(self) -> Normal:
        return Normal(np.array(self.start), self.spread**2 * np.eye(2))

    def transition(self, x: Array, k: int) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        return np.stack(
            [angle + self.step * rate, rate - self.step * self.gravity * np.sin(angle)], axis=-1
        )

    def observe(self, x: Array, k: int) -> Array:
        return np.sin(x[..., :1])

    def gain(self, k: int) -> Array:
        return root(white_acceleration(self.step, self.density))

    def R(self, k: int) -> Array:
        return np.array([[self.variance]])


@dataclass(frozen=True)
class Growth(Steady):
    """The univariate nonstationary growth model: the reading is the square of the state, so that
    its sign stays open (Netto, Gimeno, Mendes, IFAC 1978; Gordon, Salmond, Smith, IEE Proc. F 140,
    1993)."""

    variance: NonNegative = 10.0
    """Of the process noise."""

    @property
    def states(self) -> tuple[Parameter, ...]:
        return (Parameter("state"),)

    @property
    def prior(self) -> Normal:
        return Normal(np.zeros(1), np.array([[2.0]]))

    def transition(self, x: Array, k: int) -> Array:
        return x / 2 + 25 * x / (1 + x * x) + 8 * np.cos(1.2 * (k + 1))

    def observe(self, x: Array, k: int) -> Array:
        return x * x / 20

    def gain(self, k: int) -> Array:
        return np.array([[np.sqrt(self.variance)]])

    def R(self, k: int) -> Array:
        return np.eye(1)


@dataclass(frozen=True)
class ConstantVelocity(Steady):
    """A position with a nearly constant velocity, whose position is read: linear, so the Kalman
    filter is exact."""

    density: NonNegative = 1.0
    """Spectral density of the acceleration, m^2/s^3."""
    deviation: Positive = 1.0
    """Standard deviation of a reading, m."""
    spread: Positive = 10.0
    """Standard deviation of the prior, in m and in m/s."""

    @property
    def states(self) -> tuple[Parameter, ...]:
        return Parameter("position", "m"), Parameter("velocity", "m/s")

    @property
    def prior(self) -> Normal:
        return Normal(np.zeros(2), self.spread**2 * np.eye(2))

    def transition(self, x: Array, k: int) -> Array:
        return np.stack([x[..., 0] + self.step * x[..., 1], x[..., 1]], axis=-1)

    def observe(self, x: Array, k: int) -> Array:
        return x[..., :1] + 0.0

    def gain(self, k: int) -> Array:
        return root(white_acceleration(self.step, self.density))

    def R(self, k: int) -> Array:
        return np.array([[self.deviation**2]])
