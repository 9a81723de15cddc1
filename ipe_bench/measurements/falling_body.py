"""A body that falls into the atmosphere, tracked by radar ranges: the classic comparison of nonlinear filters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import Ge

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Parameter, UsualNoise
from ipe_bench.measurements.ode.model import OdeMeasurement

_FOOT = 0.3048


@dataclass(frozen=True)
class FallingBody(OdeMeasurement):
    """Altitude h, velocity v (downwards) and ballistic coefficient b of a re-entering body from slant ranges.

        h' = -v,   v' = -b exp(-gamma h) v^2,   reading: sqrt(M^2 + (h - H)^2)

    with a radar at altitude H, at the horizontal distance M from the vertical along which the body falls. Gravity is
    neglected, as it is in both papers. Parameters: h and v at the start, in m and m/s, and ln(b / presumed b): the
    logarithm, because a negative b accelerates the body without limit. Readings: ranges in m, each an epoch.

    Sources: Athans, Wishner, Bertolini, Suboptimal state estimation for continuous-time nonlinear systems from discrete
    noisy measurements, IEEE Transactions on Automatic Control 13(5), 1968; Julier, Uhlmann, Durrant-Whyte, A new method
    for the nonlinear transformation of means and covariances in filters and estimators, ibid. 45(3), 2000. Their values
    are the defaults: presumed 300,000 ft, 20,000 ft/s and 3e-5 / ft with deviations of 1000 ft and 2000 ft/s; the
    radar at 100,000 ft both ways; gamma 5e-5 / ft; a range every second with a noise of 100 ft (30.48 m). Their true b,
    1e-3 / ft, is exactly one unit of error from the presumed one; their deviation of b, 1e-2 / ft, would make half of
    all bodies impossible.
    """

    altitude: float = 3e5 * _FOOT
    """Presumed altitude at the start in m; with the two that follow, the nominal point."""
    velocity: float = 2e4 * _FOOT
    """Presumed velocity in m/s."""
    ballistic: Positive = 3e-5 / _FOOT
    """Presumed ballistic coefficient in 1/m."""
    radar_distance: float = 1e5 * _FOOT
    """M in m."""
    radar_altitude: float = 1e5 * _FOOT
    """H in m."""
    density_decay: float = 5e-5 / _FOOT
    """gamma in 1/m: the density of the air falls with altitude like exp(-gamma h)."""
    interval: Positive = 1.0
    """Time between ranges in s."""
    readings: Annotated[int, Ge(4)] = 60
    altitude_size: Positive = 1e3 * _FOOT
    """What one unit of error of the altitude is, in m."""
    velocity_size: Positive = 2e3 * _FOOT
    """What one unit of error of the velocity is, in m/s."""
    ballistic_size: Positive = float(np.log(1e-3 / 3e-5))
    """What one unit of error of the logarithm of the ballistic coefficient is."""
    step: Positive | None = None
    """A longest step in s for all trials; None: each trial's follows its parameters."""
    sampled: tuple[float, ...] | None = None
    """Times of the ranges in s, in place of equal intervals."""

    states, outputs, reading_unit, tolerance = 2, ("range",), "m", 1e-5
    usual_noise = UsualNoise(100 * _FOOT)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("altitude", "m", self.altitude_size),
            Parameter("velocity", "m/s", self.velocity_size),
            Parameter("ln_ballistic", size=self.ballistic_size),
        )

    @cached_property
    def nominal(self) -> Array:
        return np.array([self.altitude, self.velocity, 0.0]) / self.sizes

    @cached_property
    def times(self) -> Array:
        return self.interval * np.arange(1.0, self.readings + 1) if self.sampled is None else np.array(self.sampled)

    def start(self, p, c):
        return p[0], p[1]

    def rhs(self, t, y, p, c):
        altitude, velocity = y
        drag = self.ballistic * np.exp(p[2] - self.density_decay * altitude)
        return -velocity, -drag * velocity * velocity

    def read(self, t, y, p, c):
        above = y[0] - self.radar_altitude
        return (np.sqrt(self.radar_distance**2 + above * above),)
