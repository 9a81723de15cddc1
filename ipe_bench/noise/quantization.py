"""Read-outs rounded to a step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.noise.base import GINS_STEP, Noise

_UNIFORM_DEVIATION = 1 / np.sqrt(12)


@dataclass(frozen=True)
class Quantization(Noise):
    """z = step * round((offset + h) / step) - offset: the instruments' whole read-out is rounded, not its error.

    Rounding the difference instead would give equal errors in cases that differ in sign alone. The error is taken to be
    uniform, R = step^2 / 12, unless `deviation` states it. With `dither` a uniform error of one step is added before
    rounding and taken off again: then the error is uniform and independent of h, which at small h it otherwise is not.
    """

    step: Positive = GINS_STEP
    """In the unit of the readings."""
    deviation: Positive | None = None
    dither: bool = False

    @property
    def true_covariance(self) -> bool:
        return self.deviation is None

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        shift = self.step * (rng.random(h.shape) - 0.5) if self.dither else 0.0
        return self.step * np.rint((offset + h + shift) / self.step) - offset - shift

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Uniform."""
        return (rng.random(shape) - 0.5) / _UNIFORM_DEVIATION

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.deviation or self.step * _UNIFORM_DEVIATION))
