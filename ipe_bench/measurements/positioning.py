"""Where something is: from ranges to beacons, from pseudo-ranges to satellites, or from bearings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import MinLen

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements.base import Epochs, Input, Measurement, Parameter, UsualNoise, one_by_one, parameter_table

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
    ("galileo", 29_600e3, 45.0, 45.0), ("galileo", 29_600e3, 110.0, 15.0), ("galileo", 29_600e3, 185.0, 70.0),
    ("galileo", 29_600e3, 290.0, 35.0),
)  # fmt: skip
"""Constellation, radius of the orbit in m, azimuth and elevation in degrees of the satellites that are the default."""

_BEACONS = (
    (1000.0, 0.0, 300.0), (500.0, 866.0, 20.0), (-500.0, 866.0, 300.0), (-1000.0, 0.0, 20.0), (-500.0, -866.0, 300.0),
    (500.0, -866.0, 20.0), (0.0, 0.0, 600.0),
)  # fmt: skip


@dataclass(frozen=True)
class Ranging(Measurement):
    """Pseudoranges |s_i - p| + b from a receiver at p with clock bias b to beacons at known places s_i.

    Parameters: east, north, up in m, and the clock bias as a length in m. Readings: pseudoranges in m, in `rounds` over
    all beacons; each round is an epoch.

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

    nominal = cached_property(lambda ranging: np.append(ranging.position, 0.0) / ranging.sizes)  # type: ignore[assignment]

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        rounds, beacons = np.indices((self.rounds, len(self.beacons))).reshape(2, -1) + 1
        return {"round": rounds.tolist(), "beacon": beacons.tolist()}

    epochs = cached_property(lambda ranging: tuple(np.arange(ranging.m).reshape(ranging.rounds, -1)))  # type: ignore

    def simulate(self, x: Array) -> Array:
        p = x * self.sizes
        towards = np.asarray(self.beacons, dtype=float) - p[:, None, :3]
        ranges = np.sqrt(towards[..., 0] ** 2 + towards[..., 1] ** 2 + towards[..., 2] ** 2) + p[:, 3:]
        return np.tile(ranges, (1, self.rounds))


def east_north_up(position: Array) -> Array:
    """The rows (3, 3) east, north and up at a place given in ECEF, up along the normal of the WGS 84 ellipsoid.

    The latitude is found by Bowring's formula, to better than 1e-9 rad at the surface (Survey Review 23, 1976).
    """
    x, y, z = position
    minor, p, e2 = _SEMI_MAJOR * (1.0 - _FLATTENING), math.hypot(x, y), _FLATTENING * (2.0 - _FLATTENING)
    reduced = math.atan2(z * _SEMI_MAJOR, p * minor)
    latitude = math.atan2(
        z + e2 / (1.0 - e2) * minor * math.sin(reduced) ** 3, p - e2 * _SEMI_MAJOR * math.cos(reduced) ** 3
    )
    longitude = math.atan2(y, x)
    sin_lat, cos_lat, sin_lon, cos_lon = (f(a) for a in (latitude, longitude) for f in (math.sin, math.cos))
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


@dataclass(frozen=True)
class Gnss(Measurement):
    """Pseudo-ranges r + c_e + o_s from a receiver at rest to satellites whose places at transmission are known.

    r is the distance that the signal travels: the satellite's place, in the Earth-fixed axes (ECEF, WGS 84) of the time
    of transmission, is turned by the Earth's rotation during the travel (the Sagnac correction, up to 40 m). c_e is the
    receiver's clock error in epoch e against the first constellation, o_s the constant offset of every further
    constellation s, both as lengths. Satellite clocks, troposphere and ionosphere are to be taken off the readings.

    Parameters, all in m: east, north and up of the presumed position, or its x, y and z; a clock for each epoch; an
    offset for each further constellation. Readings in m, grouped into epochs by time. The usual noise is 1 m (code).

    Sources: Kaplan and Hegarty, Understanding GPS, 2nd ed., section 2.4; Ashby, Relativity in the Global Positioning
    System, Living Reviews in Relativity 6, 2003 (rotation).
    """

    satellites: tuple[tuple[int, str, float, float, float], ...] | None = None
    """Number of the epoch, constellation, and x, y, z in m (ECEF) for each reading; None: six GPS and four Galileo
    satellites over the presumed position, each read once in each of `rounds` epochs."""
    position: tuple[float, float, float] = (-3120042.0, 4084614.0, 3764026.0)
    """The presumed position in m (ECEF): the nominal point, with clocks of 0."""
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
        towards = axes.T @ np.array([math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)])
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
        return {"epoch": list(times), "constellation": list(systems), "satellite": [next(numbers[p]) for p in pairs]}

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Epoch, constellation and the satellite's place at transmission, for each pseudo-range."""
        names = Input("epoch", int, label=True, default=1), Input("constellation", str, label=True, default="gps")
        return (*names, *(Input(f"{axis} [m]") for axis in "xyz"))

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        times, systems, places = self._columns
        columns = list(times), list(systems), *places.T.tolist()
        return dict(zip((i.heading for i in self.inputs), columns, strict=True))

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        return replace(self, satellites=tuple(zip(*(columns[i.heading] for i in self.inputs), strict=True)))

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
        return np.array([*clocks, *(np.array(systems) == name for name in self._systems[1:])], dtype=float)

    def simulate(self, x: Array) -> Array:
        values = (x * self.sizes)[:, :, None]
        place: list[Any] = [values[:, i] for i in range(3)]
        if self.frame == "enu":
            axes = east_north_up(np.asarray(self.position))
            place = [self.position[i] + sum(values[:, k] * axes[k, i] for k in range(3)) for i in range(3)]
        x, y, z = self._columns[2].T
        # The Earth turns while light travels. Each pass takes the error of the distance down by the speed of the
        # satellite's turning over that of light, 1e-5.
        distance: Any = 0.0
        for _ in range(3):
            angle = self.earth_rate / LIGHT * distance
            turned = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x, z
            distance = np.sqrt(sum((s - p) ** 2 for s, p in zip(turned, place, strict=True)))
        for k, carried in enumerate(self._biases):
            distance = distance + values[:, 3 + k] * carried
        return distance


@dataclass(frozen=True)
class Bearings(Measurement):
    """Bearings to a target of constant velocity, from an observer that sails straight legs at known courses and speeds.

    Parameters: the target's position (east, north) at time 0 in m relative to the observer's start, and its velocity in
    m/s. Readings: bearings in degrees clockwise from north, one per `interval`; each is an epoch. They are continuous
    about the nominal target's bearing, within half a turn of it, so they may leave the range 0 to 360.

    On a single leg the range is not observable: every target whose relative motion is scaled by one factor has the same
    bearings. A turn makes it observable unless the observer's acceleration points along the line of sight (Nardone and
    Aidala, Observability criteria for bearings-only target motion analysis, IEEE Transactions on Aerospace and
    Electronic Systems 17, 1981).
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
    epochs = cached_property(one_by_one)  # type: ignore[assignment]

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        place = ("east", "north"), "m", 250.0, "position"
        return parameter_table(place, (("v_east", "v_north"), "m/s", 0.25, "velocity"))

    nominal = cached_property(lambda bearings: np.array(bearings.target) / bearings.sizes)  # type: ignore[assignment]
    index = property(lambda bearings: {"time [s]": bearings.times.tolist()})  # type: ignore[assignment]

    @cached_property
    def times(self) -> Array:
        """When bearings are taken (m,), in s."""
        return self.interval * np.arange(int(sum(leg[0] for leg in self.legs) / self.interval + 1e-9) + 1)

    @cached_property
    def observer(self) -> Array:
        """Where they are taken (m, 2), east and north in m."""
        path, began = np.zeros((len(self.times), 2)), 0.0
        for duration, course, speed in self.legs:
            sailed = np.clip(self.times - began, 0.0, duration)
            heading = np.deg2rad(course)
            path += speed * sailed[:, None] * np.array([np.sin(heading), np.cos(heading)])
            began += duration
        return path

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
