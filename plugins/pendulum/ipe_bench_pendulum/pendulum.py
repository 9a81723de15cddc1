"""A pendulum from readings of its angle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive
from ipe_bench.measurements import OdeMeasurement, Parameter, UsualNoise


@dataclass(frozen=True)
class Pendulum(OdeMeasurement):
    """Length, damping and start of a pendulum, from its angle read at even times.

        angle'' = -(gravity / length) sin(angle) - damping angle'

    Parameters: the length in m, the damping in 1/s, and the angle in rad and its rate in rad/s at
    the start. Readings in rad; each is an epoch. Over many swings a slightly wrong length is wrong
    by a whole swing, so the sum of squares has a minimum for each number of swings: an estimator
    that starts too far away ends in a neighbouring one.

    Source of the equation: Landau and Lifshitz, Mechanics, section 11, problem 1; damping as in
    section 25.
    """

    length: Positive = 1.0
    """Presumed, in m; with the three that follow, the start."""
    damping: Finite = 0.02
    """Presumed, in 1/s."""
    angle: Finite = 1.2
    """Presumed at the start, in rad from hanging down."""
    rate: Finite = 0.0
    """Presumed at the start, in rad/s."""
    gravity: Positive = 9.80665
    """m/s^2, where the pendulum hangs."""
    interval: Positive = 0.2
    """Seconds between readings."""
    readings: Count = 100
    length_size: Positive = 0.01
    """What one unit of error of the length is, in m."""
    angle_size: Positive = 0.02
    """What one unit of error of the angle is, in rad; of its rate, in rad/s."""
    damping_size: Positive = 0.002
    """What one unit of error of the damping is, in 1/s."""
    deviation: NonNegative = 0.01
    """Standard deviation of a reading in rad, unless a noise says otherwise."""
    sampled: tuple[float, ...] | None = None
    """Times of the readings in s, in place of even ones."""

    states, outputs, reading_unit = 2, ("angle",), "rad"
    tolerance = 1e-8

    @property
    def usual_noise(self) -> UsualNoise:  # type: ignore[override]
        return UsualNoise(self.deviation)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("length", "m", self.length_size),
            Parameter("damping", "1/s", self.damping_size),
            Parameter("angle", "rad", self.angle_size, "start"),
            Parameter("rate", "rad/s", self.angle_size, "start"),
        )

    @property
    def nominal(self) -> Array:
        return np.array([self.length, self.damping, self.angle, self.rate]) / self.sizes

    @cached_property
    def times(self) -> Array:
        return (
            self.interval * np.arange(1, self.readings + 1)
            if self.sampled is None
            else np.array(self.sampled)
        )

    def start(self, p, c):
        return p[2], p[3]

    def rhs(self, t, y, p, c):
        return y[1], -(self.gravity / p[0]) * np.sin(y[0]) - p[1] * y[1]

    def read(self, t, y, p, c):
        return [y[0]]
