"""Target motion analysis: where a vessel is and where it goes, from bearings taken by a moving observer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Measurement, Parameter, UsualNoise, parameter_table


@dataclass(frozen=True)
class Bearings(Measurement):
    """Bearings to a target of constant velocity, from an observer that sails straight legs at known courses and speeds.

    Parameters: the target's position (east, north) at time 0 in m relative to the observer's start, and its velocity in
    m/s. Readings: bearings in degrees clockwise from north, one per `interval`; each is an epoch. They are continuous
    about the nominal target's bearing, within half a turn of it, so they may leave the range 0 to 360.

    On a single leg the range is not observable: every target whose relative motion is scaled by one factor has the same
    bearings. A turn makes it observable unless the observer's acceleration points along the line of sight (Nardone and
    Aidala, Observability criteria for bearings-only target motion analysis, IEEE Transactions on Aerospace and
    Electronic Systems 17, 1981). Estimators that linearise at the nominal point then say that H lacks rank.
    """

    legs: Annotated[tuple[tuple[float, float, float], ...], MinLen(1)] = ((900.0, 90.0, 6.0), (900.0, 330.0, 6.0))
    """The observer's legs: duration in s, course in degrees from north, speed in m/s."""
    interval: Positive = 60.0
    """Time between bearings in s; the first is taken at time 0."""
    target: tuple[float, float, float, float] = (3000.0, 5000.0, -3.0, 1.0)
    """The presumed target (east and north in m, in m/s): the nominal point."""

    reading_unit = "deg"
    usual_noise = UsualNoise(0.5)
    analytic = True

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        place = ("east", "north"), "m", 250.0, "position"
        return parameter_table(place, (("v_east", "v_north"), "m/s", 0.25, "velocity"))

    @cached_property
    def nominal(self) -> Array:
        return np.asarray(self.target, dtype=float) / self.sizes

    @cached_property
    def times(self) -> Array:
        """When bearings are taken (m,), in s."""
        total = sum(leg[0] for leg in self.legs)
        return self.interval * np.arange(int(total / self.interval + 1e-9) + 1)

    @cached_property
    def observer(self) -> Array:
        """Where they are taken (m, 2), east and north in m."""
        path = np.zeros((len(self.times), 2))
        began = 0.0
        for duration, course, speed in self.legs:
            sailed = np.clip(self.times - began, 0.0, duration)
            heading = np.deg2rad(course)
            path += speed * sailed[:, None] * np.array([np.sin(heading), np.cos(heading)])
            began += duration
        return path

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"time [s]": self.times.tolist()}

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        return tuple(np.arange(self.m)[:, None])

    def _sight(self, x: Array) -> Array:
        """The vectors (trials, m, 2) from the observer to the target."""
        p = x * self.sizes
        return p[:, None, :2] + self.times[:, None] * p[:, None, 2:] - self.observer

    @cached_property
    def _nominal_bearings(self) -> tuple[Array, Array]:
        """Unit vectors (m, 2) towards the nominal target, and their bearings (m,) in rad without jumps."""
        sight = self._sight(self.nominal[None])[0]
        bearing = np.unwrap(np.arctan2(sight[:, 0], sight[:, 1]))
        return sight / np.linalg.norm(sight, axis=1)[:, None], bearing - 2 * np.pi * np.floor(bearing[0] / (2 * np.pi))

    def simulate(self, x: Array) -> Array:
        sight = self._sight(x)
        ahead, bearing = self._nominal_bearings
        dot = sight[..., 0] * ahead[:, 0] + sight[..., 1] * ahead[:, 1]
        cross = sight[..., 0] * ahead[:, 1] - sight[..., 1] * ahead[:, 0]
        distance = np.sqrt(sight[..., 0] ** 2 + sight[..., 1] ** 2)
        # The angle from the nominal line of sight by the half-angle formula, which is analytic and within half a turn.
        return np.rad2deg(1.0) * (bearing + 2.0 * np.arctan(cross / (distance + dot)))
