"""Noise with heavy tails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.noise.base import GINS_DEVIATION, Noise


@dataclass(frozen=True)
class StudentT(Noise):
    """z = h + v with independent v of Student's t distribution, scaled to the given standard deviation.

    Estimators are told the true covariance R = deviation^2 I; what they do not know is the shape.
    """

    deviation: Positive = GINS_DEVIATION
    """Standard deviation of the errors, in the unit of the readings."""
    degrees_of_freedom: Annotated[float, Gt(2)] = 3.0
    """Above 2, for a finite variance; the smaller, the heavier the tails."""

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        # The variance of Student's t is nu / (nu - 2).
        scale = self.deviation * np.sqrt((self.degrees_of_freedom - 2) / self.degrees_of_freedom)
        return h + scale * rng.standard_t(self.degrees_of_freedom, h.shape)

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.deviation))
