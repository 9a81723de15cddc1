"""A vehicle with odometry that reads its ranges to radio beacons at unknown places."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Finite, NonNegative, Positive
from ipe_bench.measurements import Parameter
from ipe_bench.states import Fault, Normal, StateModel

_INPUTS = ("time", "beacon", "forward", "left", "turn")
_LAP = 60
"""Ranges of the drive that stands for a log: once round a circle."""


@dataclass(frozen=True)
class Plaza(StateModel):
    """Position and heading of a vehicle, and the places of the beacons that it reads its ranges to,
    one range an epoch:

        p <- p + rotation(heading) (forward, left) + walk sqrt(h) (w1, w2)
        heading <- heading + turn - drift h + turning sqrt(h) w3
        range = bias + (1 + scale) |p - beacon| + v,   v ~ N(0, deviation^2)

    with h the seconds since the range before. Odometry gives `forward`, `left` (m, in the frame of
    the vehicle at the range before) and `turn` (rad, anticlockwise); these, `time` (s) and `beacon`
    are columns of a log. Beacons stand still. Without a log it drives once round a circle.

    Source: Djugash, Hamner and Roth, Navigating with Ranging Radios: Five Data Sets with Ground
    Truth, J. Field Robotics 26 (2009), 689-695.
    """

    beacons: Mapping[str, tuple[Finite, Finite]]
    """Presumed place (x, y) in m of each beacon, by its number in the log."""
    beacon_spread: Positive = 30.0
    """Standard deviation of each of their coordinates in the prior, m."""
    start: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """x and y in m and heading in rad before the first range."""
    position_spread: Positive = 1.0
    """Standard deviation of x and y there, m."""
    heading_spread: Positive = 0.1
    """Standard deviation of the heading there, rad."""
    walk: NonNegative = 0.1
    """Standard deviation by which a coordinate departs from odometry in a second, m."""
    turning: NonNegative = 0.01
    """Standard deviation by which the heading departs from odometry in a second, rad."""
    deviation: Positive = 1.0
    """Standard deviation of a range, m."""
    bias: Finite = 0.0
    """Metres by which ranges are too long."""
    scale: Finite = 0.0
    """Part of the distance by which ranges are too long."""
    drift: Finite = 0.0
    """Rate that odometry adds to turns, rad/s."""
    inputs: Mapping[str, tuple[Finite, ...]] = field(default_factory=dict)
    """The known inputs of each epoch, by name, if not those of a log."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.beacons:
            raise UserError(
                "beacons: is empty; give each beacon a presumed place, as in {1: [0, 0], 2: [30,"
                " 0]}"
            )
        numbers = {}
        for name in self.beacons:
            if not name.isdecimal() or int(name) in numbers:
                raise UserError(
                    f"beacons.{name}: give each beacon once, by its whole number in the log"
                )
            numbers[int(name)] = None
        lengths = {name: len(values) for name, values in self.inputs.items()}
        if self.inputs and (set(lengths) != set(_INPUTS) or len(set(lengths.values())) > 1):
            raise UserError(
                f"inputs: give {', '.join(_INPUTS)}, each with a number for every epoch"
            )

    @cached_property
    def drive(self) -> dict[str, Array]:
        """The known inputs (K,) of the epochs, by name."""
        if self.inputs:
            return {name: np.array(values) for name, values in self.inputs.items()}
        one, numbers = np.ones(_LAP), [int(name) for name in self.beacons]
        time, turn = 0.5 * np.arange(1, _LAP + 1), 2 * np.pi / _LAP * one
        return dict(zip(_INPUTS, (time, np.resize(numbers, _LAP), one, 0 * one, turn), strict=True))

    @cached_property
    def _steps(self) -> Array:
        """Seconds (K,) since the range before; of the first range, those of the second."""
        steps = np.diff(self.times)
        return np.concatenate([steps[:1], steps])

    @cached_property
    def _columns(self) -> list[int]:
        """The state that is x of the beacon of each epoch (K,)."""
        numbers = [int(name) for name in self.beacons]
        return [3 + 2 * numbers.index(int(one)) for one in self.drive["beacon"]]

    @property
    def states(self) -> tuple[Parameter, ...]:
        places = (Parameter(f"{axis}{name}", "m") for name in self.beacons for axis in "xy")
        return Parameter("x", "m"), Parameter("y", "m"), Parameter("heading", "rad"), *places

    @property
    def state_periods(self) -> tuple[float, ...]:
        return tuple(2 * np.pi if state.name == "heading" else 0.0 for state in self.states)

    @property
    def reading_names(self) -> tuple[str, ...]:
        return ("range",)

    @property
    def log_inputs(self) -> tuple[str, ...]:
        return _INPUTS

    @property
    def times(self) -> Array:
        return self.drive["time"]

    @property
    def prior(self) -> Normal:
        places = np.ravel(list(self.beacons.values()))
        deviations = (
            [self.position_spread] * 2 + [self.heading_spread] + [self.beacon_spread] * len(places)
        )
        return Normal(np.concatenate([self.start, places]), np.diag(deviations) ** 2)

    def transition(self, x: Array, k: int) -> Array:
        forward, left, turn = (self.drive[name][k] for name in ("forward", "left", "turn"))
        sin, cos, new = np.sin(x[..., 2]), np.cos(x[..., 2]), x.copy()
        new[..., 0] += cos * forward - sin * left
        new[..., 1] += sin * forward + cos * left
        new[..., 2] += turn - self.drift * self._steps[k]
        return new

    def observe(self, x: Array, k: int) -> Array:
        at = self._columns[k]
        distance = np.sqrt((x[..., at] - x[..., 0]) ** 2 + (x[..., at + 1] - x[..., 1]) ** 2)
        return (self.bias + (1 + self.scale) * distance)[..., None]

    def gain(self, k: int) -> Array:
        G = np.zeros((self.n, 3))
        G[[0, 1, 2], [0, 1, 2]] = np.sqrt(self._steps[k]) * np.array(
            [self.walk, self.walk, self.turning]
        )
        return G

    def R(self, k: int) -> Array:
        return np.array([[self.deviation**2]])

    def with_log(self, count: int, inputs: Mapping[str, Array]) -> Plaza:
        return replace(
            self, inputs={name: tuple(values.tolist()) for name, values in inputs.items()}
        )

    def faults(self, columns: Mapping[str, Array]) -> Iterator[Fault]:
        numbers = [int(name) for name in self.beacons]
        absent = ~np.isin(columns["beacon"], numbers)
        if absent.any():
            one = f"{columns['beacon'][np.argmax(absent)]:g}"
            remedy = f"give it one by +state_model.beacons.{one}=[X,Y], or remove its rows"
            yield Fault("beacon", absent, f"beacon {one} has no presumed place; {remedy}")
        yield Fault(
            "range",
            columns["range"] < 0,
            "is negative; correct it, or leave the cell empty if it is missing",
        )
