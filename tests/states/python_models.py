"""Models of the literature in Python: what those of conf/model, by formulas, are held against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive
from ipe_bench.measurements import Parameter
from ipe_bench.states import Gaussian
from ipe_bench.states.algebra import root
from ipe_bench.states.models import Steady, white_acceleration


@dataclass(frozen=True)
class Pendulum(Steady):
    """Angle and rate of a pendulum pushed by white noise, seen by the sine of the angle (Särkkä and Svensson, Bayesian
    Filtering and Smoothing, 2nd ed., 2023, examples 3.7 and 4.6)."""

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
    def prior(self) -> Gaussian:
        return Gaussian(np.array(self.start), self.spread**2 * np.eye(2))

    def transition(self, x: Array, k: int) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        return np.stack([angle + self.step * rate, rate - self.step * self.gravity * np.sin(angle)], axis=-1)

    def observe(self, x: Array, k: int) -> Array:
        return np.sin(x[..., :1])

    def gain(self, k: int) -> Array:
        return root(white_acceleration(self.step, self.density))

    def R(self, k: int) -> Array:
        return np.array([[self.variance]])


@dataclass(frozen=True)
class Growth(Steady):
    """The univariate nonstationary growth model: the reading is the square of the state, so that its sign stays open
    (Netto, Gimeno, Mendes, IFAC 1978; Gordon, Salmond, Smith, IEE Proc. F 140, 1993)."""

    variance: NonNegative = 10.0
    """Of the process noise."""

    @property
    def states(self) -> tuple[Parameter, ...]:
        return (Parameter("state"),)

    @property
    def prior(self) -> Gaussian:
        return Gaussian(np.zeros(1), np.array([[2.0]]))

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
    """A position with a nearly constant velocity, whose position is read: linear, so the Kalman filter is exact."""

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
    def prior(self) -> Gaussian:
        return Gaussian(np.zeros(2), self.spread**2 * np.eye(2))

    def transition(self, x: Array, k: int) -> Array:
        return np.stack([x[..., 0] + self.step * x[..., 1], x[..., 1]], axis=-1)

    def observe(self, x: Array, k: int) -> Array:
        return x[..., :1] + 0.0

    def gain(self, k: int) -> Array:
        return root(white_acceleration(self.step, self.density))

    def R(self, k: int) -> Array:
        return np.array([[self.deviation**2]])
