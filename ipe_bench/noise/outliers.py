"""White noise contaminated with gross errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive, Share
from ipe_bench.noise.base import GINS_DEVIATION, Noise


@dataclass(frozen=True)
class Outliers(Noise):
    """Tukey's contaminated normal: each reading is, with probability `share`, `factor` times as noisy as it should be.

    `assumed` is what estimators are told: `nominal`, the variance of the good readings, as if there were no outliers;
    or `total`, the variance of the mixture, deviation^2 (1 - share + share factor^2).
    """

    deviation: Positive = GINS_DEVIATION
    """Standard deviation of a good reading, in the unit of the readings."""
    share: Share = 0.05
    factor: Positive = 10.0
    assumed: Literal["nominal", "total"] = "nominal"

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        gross = rng.random(h.shape) < self.share
        return h + self.deviation * np.where(gross, self.factor, 1.0) * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        excess = 1.0 if self.assumed == "nominal" else np.sqrt(1 - self.share + self.share * self.factor**2)
        return Covariance(np.full(m, self.deviation * excess))
