"""Independent errors of one distribution: Gaussian, of heavy tails, with outliers, of rounding, and none at all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Gt

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive, Share
from ipe_bench.measurements.base import UsualNoise
from ipe_bench.noise.base import UNIFORM_DEVIATION, Noise, ScaledNoise


@dataclass(frozen=True)
class Gaussian(ScaledNoise):
    """z = h + v with independent v of the given standard deviation, in the unit of the readings; or of one for each
    reading."""

    deviation: Positive | tuple[Positive, ...] | None = None
    """One standard deviation, or one for each reading; None: that of the model's usual noise."""

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self._deviations(len(h)) * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.array(np.broadcast_to(self._deviations(m), m)))

    def _deviations(self, m: int) -> Array | float:
        if isinstance(self.deviation, tuple) and len(self.deviation) != m:
            raise UserError(f"noise.deviation: has {len(self.deviation)} numbers; give one for each of {m} readings")
        return np.asarray(self.deviation) if isinstance(self.deviation, tuple) else self.stated


@dataclass(frozen=True)
class NoNoise(ScaledNoise):
    """z = h exactly, while estimators assume readings of the nominal standard deviation."""

    name = "none"

    @property
    def true_covariance(self) -> bool:
        return False

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.stated))


@dataclass(frozen=True)
class StudentT(ScaledNoise):
    """z = h + v with independent v of Student's t distribution, scaled to the given standard deviation.

    Estimators are told the true covariance R = deviation^2 I; what they do not know is the shape.
    """

    degrees_of_freedom: Annotated[float, Gt(2)] = 3.0
    """Above 2, for a finite variance; the smaller, the heavier the tails."""

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self.stated * self.whitened(h.shape, rng)

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Student's t, scaled to variance 1."""
        # The variance of Student's t is nu / (nu - 2).
        scale = np.sqrt((self.degrees_of_freedom - 2) / self.degrees_of_freedom)
        return scale * rng.standard_t(self.degrees_of_freedom, shape)

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.stated))


@dataclass(frozen=True)
class Outliers(ScaledNoise):
    """Tukey's contaminated normal: each reading is, with probability `share`, `factor` times as noisy as it should be.

    `deviation` is that of a good reading. `assumed` is what estimators are told: `nominal`, the variance of the good
    readings, as if there were no outliers; or `total`, that of the mixture, deviation^2 (1 - share + share factor^2).
    """

    share: Share = 0.05
    factor: Positive = 10.0
    assumed: Literal["nominal", "total"] = "nominal"

    @property
    def true_covariance(self) -> bool:
        return self.assumed == "total"

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self.stated * self._mixture(h.shape, rng)

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
        return Covariance(np.full(m, self.stated * excess))


@dataclass(frozen=True)
class Quantization(Noise):
    """z = step * round((offset + h) / step) - offset: the instruments' whole read-out is rounded, not its error.

    Rounding the difference instead would give equal errors in cases that differ in sign alone. The error is taken to be
    uniform, R = step^2 / 12, unless `deviation` states it. With `dither` a uniform error of one step is added before
    rounding and taken off again: then the error is uniform and independent of h, which at small h it otherwise is not.
    """

    step: Positive | None = None
    """In the unit of the readings; None: that of the model's usual noise."""
    deviation: Positive | None = None
    dither: bool = False

    def completed(self, usual: UsualNoise | None) -> Quantization:
        return self if self.step or usual is None else replace(self, step=usual.step)

    @property
    def _size(self) -> float:
        if self.step is None:
            raise UserError(
                "noise.step: is not given for noise=quantization, and the measurement model names no step of its own; "
                "give the step of the read-out in the unit of the readings, noise.step=X"
            )
        return self.step

    @property
    def true_covariance(self) -> bool:
        return self.deviation is None

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        shift = self._size * (rng.random(h.shape) - 0.5) if self.dither else 0.0
        return self._size * np.rint((offset + h + shift) / self._size) - offset - shift

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Uniform."""
        return (rng.random(shape) - 0.5) / UNIFORM_DEVIATION

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.deviation or self._size * UNIFORM_DEVIATION))
