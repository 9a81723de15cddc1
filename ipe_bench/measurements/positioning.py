"""Where something is: from ranges to beacons, or from bearings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements.base import (
    Epochs,
    Measurement,
    Parameter,
    UsualNoise,
    parameter_table,
    single_epochs,
)

_BEACONS = (
    (1000.0, 0.0, 300.0),
    (500.0, 866.0, 20.0),
    (-500.0, 866.0, 300.0),
    (-1000.0, 0.0, 20.0),
    (-500.0, -866.0, 300.0),
    (500.0, -866.0, 20.0),
    (0.0, 0.0, 600.0),
)


@dataclass(frozen=True)
class Ranging(Measurement):
    """Measures pseudoranges |s_i - p| + b from a receiver at p with clock bias b to beacons at
    known places s_i.

    Parameters: east, north, up in m, and the clock bias as a length in m. Readings: pseudoranges in
    m, in `rounds` over all beacons; each round is an epoch.

    Source: Kaplan and Hegarty, Understanding GPS, 2nd ed., section 2.4. The problem has a closed
    form: Bancroft, An algebraic solution of the GPS equations, IEEE Transactions on Aerospace and
    Electronic Systems 21, 1985.
    """

    beacons: tuple[tuple[float, float, float], ...] = _BEACONS
    """East, north, up of each beacon in m."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The presumed position of the receiver in m: the start."""
    rounds: Count = 3

    reading_unit = "m"
    usual_noise = UsualNoise(0.1)
    analytic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.beacons) * self.rounds < 5:
            raise UserError("beacons: give at least 5 readings over all rounds")

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        place = ("east", "north", "up"), "m", 10.0, "position"
        return parameter_table(place, (("clock",), "m", 10.0, "clock bias"))

    @cached_property
    def nominal(self) -> Array:
        return np.append(self.position, 0.0) / self.sizes

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        places = np.indices((self.rounds, len(self.beacons))).reshape(2, -1)
        rounds, beacons = (places + 1).tolist()
        return {"round": rounds, "beacon": beacons}

    @cached_property
    def epochs(self) -> Epochs:
        return tuple(np.arange(self.m).reshape(self.rounds, -1))

    def simulate(self, x: Array) -> Array:
        p = x * self.sizes
        towards = np.asarray(self.beacons, dtype=float) - p[:, None, :3]
        # Written out rather than by np.linalg.norm, which is not analytic.
        distances = np.sqrt(towards[..., 0] ** 2 + towards[..., 1] ** 2 + towards[..., 2] ** 2)
        return np.tile(distances + p[:, 3:], (1, self.rounds))


@dataclass(frozen=True)
class Bearings(Measurement):
    """Measures bearings to a target of constant velocity from an observer on straight legs of known
    courses and speeds.

    Parameters: the target's position (east, north) at time 0 in m relative to the observer's start,
    and its velocity in m/s. Readings: bearings in degrees clockwise from north, one per `interval`;
    each is an epoch. Simulated ones are within half a turn of the nominal target's; whole turns of
    a reading say nothing.

    On a single leg the range is not observable: every target whose relative motion is scaled by one
    factor has the same bearings. A turn makes it observable unless the observer's acceleration
    points along the line of sight (Nardone and Aidala, Observability criteria for bearings-only
    target motion analysis, IEEE Transactions on Aerospace and Electronic Systems 17, 1981).
    """

    legs: Annotated[tuple[tuple[float, float, float], ...], MinLen(1)] = (
        (900.0, 90.0, 6.0),
        (900.0, 330.0, 6.0),
    )
    """The observer's legs: duration in s, course in degrees from north, speed in m/s."""
    interval: Positive = 60.0
    """Time between bearings in s; the first is taken at time 0."""
    target: tuple[float, float, float, float] = (3000.0, 5000.0, -3.0, 1.0)
    """The presumed target (east and north in m, in m/s): the start."""

    reading_unit = "deg"
    usual_noise = UsualNoise(0.5)
    analytic = True

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        place = ("east", "north"), "m", 250.0, "position"
        return parameter_table(place, (("v_east", "v_north"), "m/s", 0.25, "velocity"))

    @cached_property
    def nominal(self) -> Array:
        return np.array(self.target) / self.sizes

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"time [s]": self.times.tolist()}

    @cached_property
    def epochs(self) -> Epochs:
        return single_epochs(self)

    @property
    def periods(self) -> Array:
        return np.full(self.m, 360.0)

    @cached_property
    def times(self) -> Array:
        """Times of the bearings (m,), in s."""
        span = sum(leg[0] for leg in self.legs)
        # More by a little, so that round-off leaves out no bearing.
        intervals = int(span / self.interval + 1e-9)
        return self.interval * np.arange(intervals + 1)

    @cached_property
    def observer(self) -> Array:
        """Places of the observer at these times (m, 2), east and north in m."""
        path = np.zeros((len(self.times), 2))
        began = 0.0
        for duration, course, speed in self.legs:
            sailed = np.clip(self.times - began, 0.0, duration)
            heading = np.deg2rad(course)
            ahead = np.array([np.sin(heading), np.cos(heading)])
            path += speed * sailed[:, None] * ahead
            began += duration
        return path

    def _sight(self, x: Array) -> Array:
        """Returns the vectors (trials, m, 2) from the observer to the target."""
        p = x * self.sizes
        start = p[:, None, :2]
        velocity = p[:, None, 2:]
        return start + self.times[:, None] * velocity - self.observer

    @cached_property
    def _nominal_bearings(self) -> tuple[Array, Array]:
        """Unit vectors (m, 2) towards the nominal target, and their bearings (m,) in rad without
        jumps."""
        sight = self._sight(self.nominal[None])[0]
        ahead = sight / np.linalg.norm(sight, axis=1)[:, None]
        bearing = np.unwrap(np.arctan2(sight[:, 0], sight[:, 1]))
        # The first is between 0 and a whole turn.
        turns = np.floor(bearing[0] / (2 * np.pi))
        return ahead, bearing - 2 * np.pi * turns

    def simulate(self, x: Array) -> Array:
        sight = self._sight(x)
        ahead, bearing = self._nominal_bearings
        east = sight[..., 0]
        north = sight[..., 1]
        dot = east * ahead[:, 0] + north * ahead[:, 1]
        cross = east * ahead[:, 1] - north * ahead[:, 0]
        distance = np.sqrt(east**2 + north**2)
        # The angle from the nominal line of sight by the half-angle formula, which is analytic and
        # within half a turn.
        angle = 2.0 * np.arctan(cross / (distance + dot))
        return np.rad2deg(1.0) * (bearing + angle)
