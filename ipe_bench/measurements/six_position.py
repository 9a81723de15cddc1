"""Calibration of accelerometers and gyros on a turntable: six positions, at rest and turning, all of them known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Input, Measurement, Parameter, UsualNoise

SENSORS = ("ax", "ay", "az", "gx", "gy", "gz")
_FORCE, _RATE = [f"f{a} [m/s^2]" for a in "xyz"], [f"w{a} [deg/s]" for a in "xyz"]
_ANGLES = ("yz", "zy", "xz", "zx", "xy", "yx")
_GROUPS = ("bias", "scale factor", "misalignment")
_BIAS_SIZE, _SCALE_SIZE, _MISALIGNMENT_SIZE = 50.0, 0.02, 0.01
"""One unit of error: of a bias in counts, of a scale factor as a fraction of it, of an angle in rad."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SixPosition(Measurement):
    """Raw counts r of a triad of accelerometers and one of gyros, where a turntable shows them the specific force f and
    the rate w, both in the axes of the table:

        f = Ta Ka (ra - ba),   w = Tg Kg (rg - bg)

        T = [[1, -yz, zy], [xz, 1, -zx], [-xy, yx, 1]],   K = diag(kx, ky, kz)

    b is a bias in counts, K the scale in m/s^2 and deg/s per count, and T leads from the axes of the sensors to those
    of the table: the angle ij is that of sensor axis i about table axis j, small. A row is a reading of one sensor,
    `ax` to `gz`, with f and w there; w includes the rotation of the Earth where that counts, and rest is w = 0.

    Parameters: of the accelerometers three biases in counts (bax), three scale factors in ppm of the presumed ones
    (kax) and six angles in mrad (ayz), and the same of the gyros (bgx, kgx, gyz). The usual noise is 1 count, for
    averages of a second or more.

    Source: the form is that of Tedaldi, Pretto, Menegatti, A robust and easy to implement method for IMU calibration
    without external equipments, IEEE International Conference on Robotics and Automation, 2014 (there b is added); the
    six positions, at rest and turning either way, that of Syed, Aggarwal, Goodall, Niu, El-Sheimy, A new multi-position
    calibration method for MEMS inertial navigation systems, Measurement Science and Technology 18, 2007.
    """

    sensors: Annotated[tuple[str, ...], MinLen(1)] | None = None
    """Which sensor each reading is of; None, as the two that follow: each axis up and down, at rest and turning either
    way about the vertical, and all six sensors in each."""
    force: tuple[Vector, ...] | None = None
    """f at each reading, in m/s^2."""
    rate: tuple[Vector, ...] | None = None
    """w at each reading, in deg/s."""
    turning: Positive = 60.0
    """The rate of the table in deg/s, where there is no file."""
    gravity: Positive = 9.80665
    """The local gravity in m/s^2, where there is no file."""
    bias: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Presumed biases in counts, of ax, ay, az, gx, gy, gz; with those that follow, the nominal point."""
    scale: tuple[Positive, Positive, Positive, Positive, Positive, Positive] = (
        *(0.0024, 0.0024, 0.0024),
        *(0.0076, 0.0076, 0.0076),
    )
    """Presumed scale factors in m/s^2 per count, and in deg/s per count."""

    analytic = True
    reading_unit = "counts"
    usual_noise = UsualNoise(1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [len(part) for part in (self.sensors, self.force, self.rate) if part is not None]
        if len(given) in (1, 2) or len(set(given)) > 1:
            raise UserError("sensors: give force and rate with them, an entry of each for every reading, or none")
        for name in self.sensors or ():
            if name not in SENSORS:
                raise UserError(f"sensor={name}: {unknown(name, SENSORS, 'sensor')}")

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(self._parameters())

    def _parameters(self) -> Iterator[Parameter]:
        for kind, triad in (("a", "accelerometer"), ("g", "gyro")):
            bias, scale, angle = (f"{triad} {group}" for group in _GROUPS)
            yield from (Parameter(f"b{kind}{a}", "counts", _BIAS_SIZE, bias) for a in "xyz")
            yield from (Parameter(f"k{kind}{a}", "ppm", 1e6 * _SCALE_SIZE, scale) for a in "xyz")
            yield from (Parameter(f"{kind}{pair}", "mrad", 1e3 * _MISALIGNMENT_SIZE, angle) for pair in _ANGLES)

    @cached_property
    def nominal(self) -> Array:
        nothing = [0.0] * 9
        return np.array([*self.bias[:3], *nothing, *self.bias[3:], *nothing]) / self.sizes

    @cached_property
    def _readings(self) -> tuple[tuple[str, ...], Array, Array]:
        """Sensors, f and w of all readings."""
        if self.sensors is not None:
            return self.sensors, np.array(self.force, dtype=float), np.array(self.rate, dtype=float)
        places = [(sign * up, turn) for up in np.eye(3) for sign in (1, -1) for turn in (0, 1, -1)]
        f = np.repeat([self.gravity * up for up, _ in places], len(SENSORS), axis=0)
        w = np.repeat([self.turning * turn * up for up, turn in places], len(SENSORS), axis=0)
        return SENSORS * len(places), f, w

    @property
    def inputs(self) -> tuple[Input, ...]:
        return Input("sensor", str, label=True), *(Input(heading) for heading in (*_FORCE, *_RATE))

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        sensors, f, w = self._readings
        columns = zip((*_FORCE, *_RATE), np.concatenate([f, w], axis=1).T.tolist(), strict=True)
        return {"sensor": list(sensors), **dict(columns)}

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        force, rate = (tuple(zip(*(columns[h] for h in part), strict=True)) for part in (_FORCE, _RATE))
        return replace(self, sensors=tuple(columns["sensor"]), force=force, rate=rate)

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        sensors = self._readings[0]
        return {"row": list(range(1, len(sensors) + 1)), "sensor": list(sensors)}

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        """The successive readings of one position."""
        _, f, w = self._readings
        moved = np.any(np.diff(np.concatenate([f, w], axis=1), axis=0) != 0, axis=1)
        return tuple(np.split(np.arange(self.m), np.flatnonzero(moved) + 1))

    def simulate(self, x: Array) -> Array:
        sensors, f, w = self._readings
        p = x * self.sizes
        outputs = [self._counts(p[:, :12], self.scale[:3], f), self._counts(p[:, 12:], self.scale[3:], w)]
        place = np.array([SENSORS.index(name) for name in sensors])
        return np.concatenate(outputs, axis=1)[:, place, np.arange(len(place))]

    def _counts(self, p: Array, scale: Sequence[float], shown: Array) -> Array:
        """The outputs (trials, 3, readings) of a triad to which `shown` (readings, 3) is shown."""
        T = np.broadcast_to(np.eye(3, dtype=p.dtype), (len(p), 3, 3)).copy()
        yz, zy, xz, zx, xy, yx = (1e-3 * p[:, 6:]).T
        T[:, 0, 1], T[:, 0, 2], T[:, 1, 0], T[:, 1, 2], T[:, 2, 0], T[:, 2, 1] = -yz, zy, xz, -zx, -xy, yx
        A = T * (np.array(scale) * (1.0 + 1e-6 * p[:, 3:6]))[:, None, :]
        with np.errstate(all="ignore"):
            return p[:, :3, None] + np.matmul(_inverse(A), shown.T)


def _inverse(A: Array) -> Array:
    """Of each A (trials, 3, 3), complex or not, by its cross products; not finite where there is none."""
    columns = [np.cross(A[:, i], A[:, (i + 1) % 3]) for i in (1, 2, 0)]
    determinant = np.einsum("ti,ti->t", A[:, 0], columns[0])
    return np.stack(columns, axis=2) / determinant[:, None, None]
