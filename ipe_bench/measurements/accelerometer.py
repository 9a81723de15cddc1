"""Calibration of a triad of accelerometers from raw counts in static attitudes, of which only gravity is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import MinLen

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Measurement, Parameter, UsualNoise
from ipe_bench.measurements.triad import Magnitudes, attitudes

_BIAS_SIZE, _SCALE_SIZE, _MISALIGNMENT_SIZE = 50.0, 0.02, 0.01
"""One unit of error: of a bias in counts, of a scale factor as a fraction of it, of an angle in rad."""


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

    counts: Annotated[tuple[tuple[float, float, float], ...], MinLen(10)] | None = None
    """Counts r_k (attitudes, 3); None: those of a triad as presumed, in 26 directions."""
    bias: tuple[float, float, float] = (32768.0, 32768.0, 32768.0)
    """The presumed bias in counts; with the two that follow, the nominal point."""
    scale: tuple[Positive, Positive, Positive] = (0.0024, 0.0024, 0.0024)
    """The presumed scale factors in m/s^2 per count."""
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The presumed angles ayz, azy, azx in rad."""
    gravity: Positive = 9.80665
    """Local gravity in m/s^2."""

    reading_unit = "m/s^2"
    usual_noise = UsualNoise(5e-3)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            *(Parameter(f"b{a}", "counts", _BIAS_SIZE, "bias") for a in "xyz"),
            *(Parameter(f"k{a}", "ppm", 1e6 * _SCALE_SIZE, "scale factor") for a in "xyz"),
            *(Parameter(f"a{a}", "mrad", 1e3 * _MISALIGNMENT_SIZE, "misalignment") for a in ("yz", "zy", "zx")),
        )

    @cached_property
    def nominal(self) -> Array:
        return np.concatenate([self.bias, np.zeros(3), 1e3 * np.array(self.misalignment)]) / self.sizes

    @property
    def output_unit(self) -> str:
        return "counts"

    def with_outputs(self, outputs: tuple[tuple[float, float, float], ...]) -> Measurement:
        return replace(self, counts=outputs)

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
