"""Calibration of three accelerometers or magnetometers by the magnitude of what they measure."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import MinLen

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import (
    Input,
    Measurement,
    Parameter,
    UsualNoise,
    parameter_table,
    single_epochs,
)

Vector = tuple[float, float, float]


def attitudes() -> Array:
    """26 directions (26, 3): towards the faces, edges and corners of a cube."""
    return np.array(
        [np.array(v) / np.linalg.norm(v) for v in product((-1.0, 0.0, 1.0), repeat=3) if any(v)]
    )


class Magnitudes(Measurement):
    """The magnitude of a vector that a triad was exposed to in each of its attitudes, from the
    outputs of the triad.

    Parameters: three biases in the unit of the outputs, three scale factors in ppm, three angles in
    mrad. Each attitude is an epoch. Outputs are taken to be exact, with their noise counted in the
    readings.
    """

    analytic = True
    epochs = cached_property(single_epochs)  # type: ignore[assignment]
    outputs_option: ClassVar[str]
    """The name of the option that holds the outputs."""
    angles: ClassVar[tuple[str, str, str]]
    """The names of the three angles."""
    output_unit: str
    error_sizes: Vector
    """One unit of error: of a bias in the unit of the outputs, of a scale factor as a fraction, of
    an angle in rad."""

    @property
    @abstractmethod
    def measured(self) -> Array:
        """The outputs r_k of the triad (attitudes, 3)."""

    @abstractmethod
    def corrected(self, x: Array) -> Sequence[Array]:
        """The three components, each (trials, attitudes), of what acted on the triad."""

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        bias, scale, angle = self.error_sizes
        return parameter_table(
            (("bx", "by", "bz"), self.output_unit, bias, "bias"),
            (("kx", "ky", "kz"), "ppm", 1e6 * scale, "scale factor"),
            (self.angles, "mrad", 1e3 * angle, "misalignment"),
        )

    inputs = property(lambda triad: tuple(Input(f"{axis} [{triad.output_unit}]") for axis in "xyz"))  # type: ignore
    """What the triad shows in each attitude."""

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        return {i.heading: self.measured[:, k].tolist() for k, i in enumerate(self.inputs)}

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        outputs = tuple(zip(*(columns[i.heading] for i in self.inputs), strict=True))
        return replace(self, **{self.outputs_option: outputs})  # type: ignore[type-var]

    index = property(lambda triad: {"attitude": list(range(1, len(triad.measured) + 1))})  # type: ignore[assignment]

    def simulate(self, x: Array) -> Array:
        a, b, c = self.corrected(x)
        return np.sqrt(a**2 + b**2 + c**2)


@dataclass(frozen=True)
class Triad(Magnitudes):
    """The magnitude |(I + E)(r_k - b)| of the vector that a triad with outputs r_k was exposed to
    in attitude k.

    b is the bias; E is symmetric, with scale-factor errors on its diagonal and misalignments beside
    it. The reading of attitude k is the magnitude that a reference states: a scalar magnetometer,
    or the local gravity.

    Parameters: three biases in `unit`, three scale-factor errors in ppm, three misalignments in
    mrad. The usual noise is 1e-5 of the field.

    Source: Merayo, Brauer, Primdahl, Petersen, Nielsen, Scalar calibration of vector magnetometers,
    Measurement Science and Technology 11, 2000.
    """

    outputs: Annotated[tuple[Vector, ...], MinLen(10)] | None = None
    """Outputs r_k of the triad (attitudes, 3) in `unit`; None: a field of `field` in 26
    directions."""
    field: Positive = 1.0
    """The magnitude about which sizes are chosen, in `unit`."""
    unit: str = "g"
    bias: Vector = (0.0, 0.0, 0.0)
    """The presumed bias in `unit`; with the two that follow, the start."""
    scale: Vector = (0.0, 0.0, 0.0)
    """The presumed scale-factor errors, as plain numbers."""
    misalignment: Vector = (0.0, 0.0, 0.0)
    """The presumed misalignments in rad."""

    outputs_option = "outputs"
    angles = ("mxy", "mxz", "myz")
    reading_unit = output_unit = property(lambda triad: triad.unit)  # type: ignore[assignment]
    usual_noise = property(lambda triad: UsualNoise(1e-5 * triad.field))  # type: ignore[assignment]
    error_sizes = property(lambda triad: (2e-3 * triad.field, 2e-3, 2e-3))  # type: ignore[assignment]

    _plain_sizes = cached_property(lambda triad: triad.sizes * np.repeat([1.0, 1e-6, 1e-3], 3))
    """Sizes (9,) with scale factors and misalignments as plain numbers."""

    @cached_property
    def nominal(self) -> Array:
        return np.concatenate([self.bias, self.scale, self.misalignment]) / self._plain_sizes

    @cached_property
    def measured(self) -> Array:
        return (
            self.field * attitudes()
            if self.outputs is None
            else np.asarray(self.outputs, dtype=float)
        )

    def corrected(self, x: Array) -> Sequence[Array]:
        p = (x * self._plain_sizes)[:, :, None]
        d = [self.measured[:, i] - p[:, i] for i in range(3)]
        a = [(1.0 + p[:, 3 + i]) * d[i] for i in range(3)]
        for k, (i, j) in enumerate(combinations(range(3), 2)):
            a[i] = a[i] + p[:, 6 + k] * d[j]
            a[j] = a[j] + p[:, 6 + k] * d[i]
        return a


@dataclass(frozen=True)
class Accelerometer(Magnitudes):
    """The magnitude |T K (r_k - b)| of specific force, from the counts r_k of a triad at rest in
    attitude k.

        T = [[1, -ayz, azy], [0, 1, -azx], [0, 0, 1]],   K = diag(kx, ky, kz)

    b is the bias in counts, K the scale in m/s^2 per count, T leads from the axes of the sensors to
    orthogonal ones, of which x is the first sensor's (small angles, as in the source). The reading
    of every attitude is the local gravity `gravity`, in m/s^2. At least 10 attitudes, spread over
    the sphere.

    Parameters: three biases in counts, three scale factors in ppm of the presumed ones, three
    angles in mrad. The usual noise is 5e-3 m/s^2 for the averages of an attitude with consumer
    sensors.

    Source: Tedaldi, Pretto, Menegatti, A robust and easy to implement method for IMU calibration
    without external equipments, IEEE International Conference on Robotics and Automation, 2014
    (there b is added). `Triad` is the same in another form: its symmetric matrix is the polar
    factor of T K.
    """

    counts: Annotated[tuple[Vector, ...], MinLen(10)] | None = None
    """Counts r_k (attitudes, 3); None: those of a triad as presumed, in 26 directions."""
    bias: Vector = (32768.0, 32768.0, 32768.0)
    """The presumed bias in counts; with the two that follow, the start."""
    scale: tuple[Positive, Positive, Positive] = (0.0024, 0.0024, 0.0024)
    """The presumed scale factors in m/s^2 per count."""
    misalignment: Vector = (0.0, 0.0, 0.0)
    """The presumed angles ayz, azy, azx in rad."""
    gravity: Positive = 9.80665
    """Local gravity in m/s^2."""

    reading_unit = "m/s^2"
    usual_noise = UsualNoise(5e-3)
    outputs_option = output_unit = "counts"
    angles = ("ayz", "azy", "azx")
    error_sizes = (50.0, 0.02, 0.01)

    @cached_property
    def nominal(self) -> Array:
        return (
            np.concatenate([self.bias, np.zeros(3), 1e3 * np.array(self.misalignment)]) / self.sizes
        )

    @cached_property
    def measured(self) -> Array:
        if self.counts is not None:
            return np.asarray(self.counts, dtype=float)
        ayz, azy, azx = self.misalignment
        T = np.array([[1.0, -ayz, azy], [0.0, 1.0, -azx], [0.0, 0.0, 1.0]])
        return self.bias + self.gravity * attitudes() @ np.linalg.inv(T * self.scale).T

    def corrected(self, x: Array) -> Sequence[Array]:
        p = (x * self.sizes)[:, :, None]
        d = [
            self.scale[i] * (1.0 + 1e-6 * p[:, 3 + i]) * (self.measured[:, i] - p[:, i])
            for i in range(3)
        ]
        ayz, azy, azx = (1e-3 * p[:, 6 + i] for i in range(3))
        return d[0] - ayz * d[1] + azy * d[2], d[1] - azx * d[2], d[2]
