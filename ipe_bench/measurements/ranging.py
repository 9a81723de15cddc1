"""Position and clock bias from ranges to beacons: trilateration, and satellite navigation in small."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count
from ipe_bench.measurements.base import Measurement, Parameter, UsualNoise, parameter_table

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
    """Pseudoranges |s_i - p| + b from a receiver at p with clock bias b to beacons at known places s_i.

    Parameters: east, north, up in m, and the clock bias as a length in m. Readings: pseudoranges in m, in `rounds` over
    all beacons; each round is an epoch. A range of rho bends by d^2 / (2 rho) for a position error d across it: 0.05 m
    at error scale 1 with the beacons given here, to be compared with a noise of 0.1 m.

    Source: Kaplan and Hegarty, Understanding GPS, 2nd ed., section 2.4. The problem has a closed form: Bancroft, An
    algebraic solution of the GPS equations, IEEE Transactions on Aerospace and Electronic Systems 21, 1985.
    """

    beacons: tuple[tuple[float, float, float], ...] = _BEACONS
    """East, north, up of each beacon in m."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The presumed position of the receiver in m: the nominal point."""
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
        return np.append(np.asarray(self.position, dtype=float), 0.0) / self.sizes

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        beacons = range(1, len(self.beacons) + 1)
        return {
            "round": [k for k in range(1, self.rounds + 1) for _ in beacons],
            "beacon": [i for _ in range(self.rounds) for i in beacons],
        }

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        return tuple(np.arange(self.m).reshape(self.rounds, -1))

    def simulate(self, x: Array) -> Array:
        p = x * self.sizes
        towards = np.asarray(self.beacons, dtype=float) - p[:, None, :3]
        ranges = np.sqrt(towards[..., 0] ** 2 + towards[..., 1] ** 2 + towards[..., 2] ** 2) + p[:, 3:]
        return np.tile(ranges, (1, self.rounds))
