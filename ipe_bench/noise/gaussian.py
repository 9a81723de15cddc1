"""White Gaussian noise, and none at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.noise.base import GINS_DEVIATION, Noise


@dataclass(frozen=True)
class Gaussian(Noise):
    """z = h + v with independent v of the given standard deviation, in the unit of the readings."""

    deviation: Positive = GINS_DEVIATION

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self.deviation * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.deviation))


@dataclass(frozen=True)
class NoNoise(Noise):
    """z = h exactly, while estimators assume readings of the nominal standard deviation."""

    deviation: Positive = GINS_DEVIATION
    name = "none"

    @property
    def true_covariance(self) -> bool:
        return False

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.deviation))
