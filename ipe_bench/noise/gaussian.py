"""White Gaussian noise, and none at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.noise.base import GINS_DEVIATION, Noise


@dataclass(frozen=True)
class Gaussian(Noise):
    """z = h + v with independent v of the given standard deviation, in the unit of the readings; or of one for each
    reading."""

    deviation: Positive | tuple[Positive, ...] = GINS_DEVIATION

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self._deviations(len(h)) * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.array(np.broadcast_to(self._deviations(m), m)))

    def _deviations(self, m: int) -> Array | float:
        if isinstance(self.deviation, tuple) and len(self.deviation) != m:
            raise UserError(f"noise.deviation: has {len(self.deviation)} numbers; give one for each of {m} readings")
        return np.asarray(self.deviation) if isinstance(self.deviation, tuple) else self.deviation


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
