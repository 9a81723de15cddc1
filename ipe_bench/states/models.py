"""State models that formulas do not reach: the coordinated turn. Others stand in `conf/model`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, NonNegative, Positive
from ipe_bench.measurements.base import Parameter
from ipe_bench.states.algebra import root
from ipe_bench.states.base import Gaussian, StateModel


def white_acceleration(step: float, density: float) -> Array:
    """Covariance (2, 2) that a white acceleration of this density adds to position and velocity in `step` seconds."""
    return density * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])


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
    """An aircraft that turns at an unknown rate, seen by range and bearing (Arasaratnam and Haykin, IEEE TAC 54, 2009,
    section VI.B)."""

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
    def prior(self) -> Gaussian:
        mean = np.array([1000.0, 300.0, 1000.0, 0.0, np.radians(-3.0)])
        return Gaussian(mean, np.diag([100.0, 10.0, 100.0, 10.0, 1e-4]))

    def transition(self, x: Array, k: int) -> Array:
        px, vx, py, vy, rate = np.moveaxis(x, -1, 0)
        rate = np.where(np.abs(rate) < 1e-9, 1e-9, rate)
        s, c = np.sin(rate * self.step), np.cos(rate * self.step)
        a, b = s / rate, (1 - c) / rate
        moved = [px + a * vx - b * vy, c * vx - s * vy, py + b * vx + a * vy, s * vx + c * vy, x[..., 4]]
        return np.stack(moved, axis=-1)

    def observe(self, x: Array, k: int) -> Array:
        px, py = x[..., 0], x[..., 2]
        return np.stack([np.sqrt(px * px + py * py), bearing(px, py)], axis=-1)

    def gain(self, k: int) -> Array:
        G = np.zeros((5, 5))
        block = root(white_acceleration(self.step, self.density))
        columns = block.shape[1]
        G[:2, :columns], G[2:4, 2 : 2 + columns], G[4, 4] = block, block, np.sqrt(self.walk * self.step)
        return G

    def R(self, k: int) -> Array:
        return np.diag([self.range_deviation**2, self.bearing_variance])


def bearing(x: Array, y: Array) -> Array:
    """The angle of (x, y) from the x axis in rad, for real or complex-step arguments."""
    if not np.iscomplexobj(x):
        return np.arctan2(y, x)
    a, b = np.real(x), np.real(y)
    return np.arctan2(b, a) + 1j * (a * np.imag(y) - b * np.imag(x)) / (a**2 + b**2)
