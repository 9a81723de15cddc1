"""Where a receiver is: from pseudo-ranges to satellites."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from typing import Any, Literal

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count
from ipe_bench.measurements.base import (
    Epochs,
    Input,
    Measurement,
    Parameter,
    UsualNoise,
    parameter_table,
)

LIGHT = 299792458.0
"""Speed of light in m/s."""
EARTH_RATE = 7.2921151467e-5
"""Rate of the Earth's rotation in rad/s, as WGS 84 and GPS define it."""
_SEMI_MAJOR, _FLATTENING = 6378137.0, 1.0 / 298.257223563
_LEAST_RADIUS = 6e6
"""Closer to the Earth's centre, in m, nothing is taken for a place on it."""

_SKY = (
    ("gps", 26_560e3, 20.0, 65.0), ("gps", 26_560e3, 75.0, 30.0), ("gps", 26_560e3, 140.0, 50.0),
    ("gps", 26_560e3, 205.0, 18.0), ("gps", 26_560e3, 260.0, 40.0), ("gps", 26_560e3, 320.0, 25.0),
    ("galileo", 29_600e3, 45.0, 45.0), ("galileo", 29_600e3, 110.0, 15.0),
    ("galileo", 29_600e3, 185.0, 70.0),
    ("galileo", 29_600e3, 290.0, 35.0),
)  # fmt: skip
"""Constellation, radius of the orbit in m, azimuth and elevation in degrees of the satellites that
are the default."""


def east_north_up(position: Array) -> Array:
    """The rows (3, 3) east, north and up at a place given in ECEF, up along the normal of the WGS
    84 ellipsoid.

    The latitude is found by Bowring's formula, to better than 1e-9 rad at the surface (Survey
    Review 23, 1976).
    """
    x, y, z = position
    minor, p, e2 = (
        _SEMI_MAJOR * (1.0 - _FLATTENING),
        math.hypot(x, y),
        _FLATTENING * (2.0 - _FLATTENING),
    )
    reduced = math.atan2(z * _SEMI_MAJOR, p * minor)
    latitude = math.atan2(
        z + e2 / (1.0 - e2) * minor * math.sin(reduced) ** 3,
        p - e2 * _SEMI_MAJOR * math.cos(reduced) ** 3,
    )
    longitude = math.atan2(y, x)
    sin_lat, cos_lat, sin_lon, cos_lon = (
        f(a) for a in (latitude, longitude) for f in (math.sin, math.cos)
    )
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


@dataclass(frozen=True)
class Gnss(Measurement):
    """Pseudo-ranges r + c_e + o_s from a receiver at rest to satellites whose places at
    transmission are known.

    r is the distance that the signal travels: the satellite's place, in the Earth-fixed axes (ECEF,
    WGS 84) of the time of transmission, is turned by the Earth's rotation during the travel (the
    Sagnac correction, up to 40 m). c_e is the receiver's clock error in epoch e against the first
    constellation, o_s the constant offset of every further constellation s, both as lengths.
    Satellite clocks, troposphere and ionosphere are to be taken off the readings.

    Parameters, all in m: east, north and up of the presumed position, or its x, y and z; a clock
    for each epoch; an offset for each further constellation. Readings in m, grouped into epochs by
    time. The usual noise is 1 m (code).

    Sources: Kaplan and Hegarty, Understanding GPS, 2nd ed., section 2.4; Ashby, Relativity in the
    Global Positioning System, Living Reviews in Relativity 6, 2003 (rotation).
    """

    satellites: tuple[tuple[int, str, float, float, float], ...] | None = None
    """Number of the epoch, constellation, and x, y, z in m (ECEF) for each reading; None: six GPS
    and four Galileo satellites over the presumed position, each read once in each of `rounds`
    epochs."""
    position: tuple[float, float, float] = (-3120042.0, 4084614.0, 3764026.0)
    """The presumed position in m (ECEF): the start, with clocks of 0."""
    frame: Literal["enu", "ecef"] = "enu"
    """In which axes the position is estimated: east, north, up, or x, y, z."""
    rounds: Count = 1
    earth_rate: float = EARTH_RATE
    """In rad/s; 0 for beacons and readings whose rotation is taken off already."""

    reading_unit = "m"
    usual_noise = UsualNoise(1.0)
    analytic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frame == "enu" and math.hypot(*self.position) < _LEAST_RADIUS:
            raise UserError("position: there is no up near the centre of the Earth; set frame=ecef")
        if self.m < self.n:
            raise UserError(f"satellites: {self.m} readings are too few for {self.n} parameters")

    @cached_property
    def _columns(self) -> tuple[tuple[int, ...], tuple[str, ...], Array]:
        """Epoch, constellation and satellite (m, 3) of each reading."""
        rows = self.satellites
        if rows is None:
            sky = [(name, *self._overhead(*direction)) for name, *direction in _SKY]
            rows = [(k, *seen) for k in range(1, self.rounds + 1) for seen in sky]
        times, systems, *places = zip(*rows, strict=True)
        return times, systems, np.array(places, dtype=float).T

    def _overhead(self, radius: float, azimuth: float, elevation: float) -> Array:
        """The place (3,) on a sphere about the Earth's centre that is seen in that direction."""
        a, e = math.radians(azimuth), math.radians(elevation)
        here = np.asarray(self.position)
        # From the centre of the Earth, any axes do.
        axes = east_north_up(here) if np.linalg.norm(here) > _LEAST_RADIUS else np.eye(3)
        towards = axes.T @ np.array(
            [math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)]
        )
        along = float(here @ towards)
        return here + (math.sqrt(along**2 + radius**2 - float(here @ here)) - along) * towards

    _systems = cached_property(lambda gnss: tuple(dict.fromkeys(gnss._columns[1])))
    """Each constellation once, in order of appearance."""
    _times = cached_property(lambda gnss: tuple(sorted(set(gnss._columns[0]))))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        axes = ("east", "north", "up") if self.frame == "enu" else ("x", "y", "z")
        clocks = [f"clock_{k}" for k in self._times] if len(self._times) > 1 else ["clock"]
        return parameter_table(
            (axes, "m", 1000.0, "position"),
            (clocks, "m", 1000.0, "clock"),
            ([f"offset_{name}" for name in self._systems[1:]], "m", 10.0, "offset"),
        )

    @cached_property
    def nominal(self) -> Array:
        place = self.position if self.frame == "ecef" else (0.0, 0.0, 0.0)
        return np.append(place, np.zeros(self.n - 3)) / self.sizes

    @cached_property
    def index(self) -> Mapping[str, Sequence[Any]]:
        times, systems, _ = self._columns
        pairs = list(zip(times, systems, strict=True))
        numbers = {pair: count(1) for pair in pairs}
        return {
            "epoch": list(times),
            "constellation": list(systems),
            "satellite": [next(numbers[p]) for p in pairs],
        }

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Epoch, constellation and the satellite's place at transmission, for each pseudo-range."""
        names = (
            Input("epoch", int, label=True, default=1),
            Input("constellation", str, label=True, default="gps"),
        )
        return (*names, *(Input(f"{axis} [m]") for axis in "xyz"))

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        times, systems, places = self._columns
        columns = list(times), list(systems), *places.T.tolist()
        return dict(zip((i.heading for i in self.inputs), columns, strict=True))

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        return replace(
            self, satellites=tuple(zip(*(columns[i.heading] for i in self.inputs), strict=True))
        )

    @property
    def own_parameters(self) -> tuple[str, ...]:
        """Every file has clocks of its own, as every epoch has."""
        return tuple(p.name for p in self.parameters if p.group == "clock")

    @cached_property
    def epochs(self) -> Epochs:
        return tuple(np.flatnonzero(np.array(self._columns[0]) == k) for k in self._times)

    @cached_property
    def _biases(self) -> Array:
        """Which of the clocks and offsets each reading carries: (n - 3, m) of zeros and ones."""
        times, systems, _ = self._columns
        clocks = [np.array(times) == k for k in self._times]
        return np.array(
            [*clocks, *(np.array(systems) == name for name in self._systems[1:])], dtype=float
        )

    def simulate(self, x: Array) -> Array:
        values = (x * self.sizes)[:, :, None]
        place: list[Any] = [values[:, i] for i in range(3)]
        if self.frame == "enu":
            axes = east_north_up(np.asarray(self.position))
            place = [
                self.position[i] + sum(values[:, k] * axes[k, i] for k in range(3))
                for i in range(3)
            ]
        x, y, z = self._columns[2].T
        # The Earth turns while light travels. Each pass takes the error of the distance down by the
        # speed of the satellite's turning over that of light, 1e-5.
        distance: Any = 0.0
        for _ in range(3):
            angle = self.earth_rate / LIGHT * distance
            turned = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x, z
            distance = np.sqrt(sum((s - p) ** 2 for s, p in zip(turned, place, strict=True)))
        for k, carried in enumerate(self._biases):
            distance = distance + values[:, 3 + k] * carried
        return distance
