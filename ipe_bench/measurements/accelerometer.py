"""Calibration of a triad of accelerometers from raw counts in static attitudes, of which only gravity is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Input, Measurement, Parameter, UsualNoise
from ipe_bench.measurements.triad import Magnitudes, attitudes


@dataclass(frozen=True)
class Accelerometer(Magnitudes):
    """The magnitude |T K (r_k - b)| of specific force, from the counts r_k of a triad at rest in attitude k.

        T = [[1, -ayz, azy], [0, 1, -azx], [0, 0, 1]],   K = diag(kx, ky, kz)

    b is the bias in counts, K the scale in m/s^2 per count, T leads from the axes of the sensors to orthogonal ones, of
    which x is the first sensor's (small angles, as in the source). The reading of every attitude is the local gravity
    `gravity`, in m/s^2: it does not tell how the triad was held, and need not. At least 10 attitudes, spread over the
    sphere.

    Parameters: three biases in counts, three scale factors in ppm of the presumed ones, three angles in mrad. The
    usual noise is 5e-3 m/s^2 for the averages of an attitude with consumer sensors.

    Source: Tedaldi, Pretto, Menegatti, A robust and easy to implement method for IMU calibration without external
    equipments, IEEE International Conference on Robotics and Automation, 2014 (there b is added). `Triad` is the same
    in another form: its symmetric matrix is the polar factor of T K.
    """

    counts: tuple[tuple[float, float, float], ...] | None = None
    """Counts r_k (attitudes, 3); None: those of a triad as presumed, in 26 directions."""
    bias: tuple[float, float, float] = (32768.0, 32768.0, 32768.0)
    """The presumed bias in counts,"""
    scale: tuple[float, float, float] = (0.0024, 0.0024, 0.0024)
    """scale factors in m/s^2 per count,"""
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """and angles ayz, azy, azx in rad: the nominal point."""
    gravity: float = 9.80665
    """Local gravity in m/s^2."""
    bias_size: float = 50.0
    """What one unit of error is: of a bias in counts,"""
    scale_size: float = 0.02
    """of a scale factor, as a fraction of it,"""
    misalignment_size: float = 0.01
    """of an angle in rad."""

    reading_unit = "m/s^2"
    usual_noise = UsualNoise(5e-3)

    def __post_init__(self) -> None:
        if self.counts is not None and (np.shape(self.counts)[1:] != (3,) or len(self.counts) < 10):
            raise UserError("counts: give three numbers for each of at least 10 attitudes")
        if min(self.scale) <= 0:
            raise UserError(f"scale={list(self.scale)}: give three numbers above 0")
        if self.gravity <= 0:
            raise UserError(f"gravity={self.gravity}: give a number above 0")

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            *(Parameter(f"b{a}", "counts", self.bias_size, "bias") for a in "xyz"),
            *(Parameter(f"k{a}", "ppm", 1e6 * self.scale_size, "scale factor") for a in "xyz"),
            *(Parameter(f"a{a}", "mrad", 1e3 * self.misalignment_size, "misalignment") for a in ("yz", "zy", "zx")),
        )

    @cached_property
    def nominal(self) -> Array:
        return np.concatenate([self.bias, np.zeros(3), 1e3 * np.array(self.misalignment)]) / self.sizes

    @property
    def inputs(self) -> tuple[Input, ...]:
        """What the triad shows in each attitude."""
        return tuple(Input(f"{axis} [counts]") for axis in "xyz")

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        return {i.heading: self.measured[:, k].tolist() for k, i in enumerate(self.inputs)}

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        return replace(self, counts=tuple(zip(*(columns[i.heading] for i in self.inputs), strict=True)))

    @cached_property
    def measured(self) -> Array:
        if self.counts is not None:
            return np.asarray(self.counts, dtype=float)
        ayz, azy, azx = self.misalignment
        T = np.array([[1.0, -ayz, azy], [0.0, 1.0, -azx], [0.0, 0.0, 1.0]])
        return self.bias + self.gravity * attitudes() @ np.linalg.inv(T * self.scale).T

    def corrected(self, x: Array) -> Sequence[Array]:
        p = (x * self.sizes)[:, :, None]
        d = [self.scale[i] * (1.0 + 1e-6 * p[:, 3 + i]) * (self.measured[:, i] - p[:, i]) for i in range(3)]
        ayz, azy, azx = (1e-3 * p[:, 6 + i] for i in range(3))
        return d[0] - ayz * d[1] + azy * d[2], d[1] - azx * d[2], d[2]
