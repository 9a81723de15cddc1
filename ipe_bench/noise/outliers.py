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

    @property
    def true_covariance(self) -> bool:
        return self.assumed == "total"

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self.deviation * self._mixture(h.shape, rng)

    def _mixture(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Errors over the deviation of a good reading."""
        gross = rng.random(shape) < self.share
        return np.where(gross, self.factor, 1.0) * rng.standard_normal(shape)

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array | None:
        """The mixture where estimators are told of it; otherwise R is that of good readings, which are normal."""
        return None if self.assumed == "nominal" else self._mixture(shape, rng) / self._excess

    @property
    def _excess(self) -> float:
        """The deviation of the mixture over that of a good reading."""
        return float(np.sqrt(1 - self.share + self.share * self.factor**2))

    def covariance(self, m: int) -> Covariance:
        excess = 1.0 if self.assumed == "nominal" else self._excess
        return Covariance(np.full(m, self.deviation * excess))
