"""Bock's problem: one parameter of an equation so unstable that integrating it forwards loses the readings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import Ge

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Parameter, Recorded, UsualNoise
from ipe_bench.measurements.ode.model import OdeMeasurement


@dataclass(frozen=True)
class Bock(OdeMeasurement):
    """The parameter p, truly pi, of an equation whose solutions grow like exp(mu t), from readings of both states.

        x1' = x2,   x2' = mu^2 x1 - (mu^2 + p^2) sin(p t),   0 < t <= 1

    With x(0) = (0, pi) and p = pi the solution is x1 = sin(pi t); for any other p it leaves that by
    (pi - p) sinh(mu t) / mu, which is 1e24 (pi - p) at the end for the classic mu = 60. Parameters: p, and with
    `initial` also x1(0) and x2(0). Readings: x1 and x2 at equal intervals up to t = 1, each time an epoch.

    `simulate` integrates forwards, as single shooting does, and its errors grow like the solutions: to about
    2e-15 exp(mu t) in x2. That is a relative 1e-12 of the readings where p is not near pi; at pi, where they are of
    order 1, it is 3e-11 for mu = 10 and 2e11 for mu = 60 at t = 1. So readings at the true p are not simulated: they
    come with the model (`recorded`, for noise=certified) from the closed form, without noise, so that the answer is pi.
    Trials drawn about the nominal point are of use for small mu only.

    Source: Bock, Numerical treatment of inverse problems in chemical reaction kinetics, Springer Series in Chemical
    Physics 18, 1981, and his thesis (Bonner Mathematische Schriften 183, 1987). A noise of 0.05 is customary.
    """

    mu: Positive = 60.0
    readings: Annotated[int, Ge(2)] = 10
    """Times at which both states are read: 1/readings, 2/readings, ..., 1."""
    guess: float = 1.0
    """The presumed p: the nominal point."""
    initial: bool = False
    """Whether the initial values are unknown too; they are presumed to be (0, pi)."""
    size: Positive = 0.1
    """What one unit of error is, of each parameter."""
    deviation: Positive = 0.05
    """The standard deviation that R states of the recorded readings."""
    step: Positive | None = None
    """A longest step for all trials; None: each trial's follows its parameters."""

    states, outputs = 2, ("x1", "x2")
    tolerance = 1e-13
    """The error that the integration may leave in a reading, times cosh(mu t), by which solutions grow."""

    @cached_property
    def _tolerances(self) -> Array:
        return np.repeat(self.tolerance * np.cosh(self.mu * self.times), 2)

    @property
    def usual_noise(self) -> UsualNoise:  # type: ignore[override]
        return UsualNoise(self.deviation)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        unknown = ("p", "x1_start", "x2_start") if self.initial else ("p",)
        return tuple(Parameter(name, size=self.size) for name in unknown)

    @cached_property
    def nominal(self) -> Array:
        return np.array([self.guess, 0.0, np.pi])[: self.n] / self.sizes

    @cached_property
    def times(self) -> Array:
        return np.arange(1, self.readings + 1) / self.readings

    def start(self, p, c):
        return (p[1], p[2]) if self.initial else (0.0, np.pi)

    def rhs(self, t, y, p, c):
        square = self.mu**2
        return y[1], square * y[0] - (square + p[0] * p[0]) * np.sin(p[0] * t)

    def read(self, t, y, p, c):
        return y

    def exact(self, x: Array) -> Array:
        """Readings (trials, m) by x1 = sin(p t) + x1(0) cosh(mu t) + (x2(0) - p) sinh(mu t) / mu and its derivative."""
        values, mu = (x * self.sizes)[:, :, None], self.mu
        p = values[:, 0]
        x1, x2 = (values[:, 1], values[:, 2]) if self.initial else (0.0, np.pi)
        grow, fall = np.cosh(mu * self.times), np.sinh(mu * self.times)
        first = np.sin(p * self.times) + x1 * grow + (x2 - p) * fall / mu
        second = p * np.cos(p * self.times) + x1 * mu * fall + (x2 - p) * grow
        return np.stack([first, second], axis=2).reshape(len(x), -1)

    @property
    def recorded(self) -> Recorded:
        """The exact readings of p = pi, and pi."""
        truth = np.array([np.pi, 0.0, np.pi])[: self.n] / self.sizes
        # Not through x * sizes, whose round-off would be multiplied by exp(mu).
        z = np.stack([np.sin(np.pi * self.times), np.pi * np.cos(np.pi * self.times)], axis=1).ravel()
        return Recorded(z, Covariance(np.full(self.m, self.deviation)), truth)
