"""Errors that remember the last one, and errors that readings share."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Lt

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Count
from ipe_bench.measurements.base import UsualNoise
from ipe_bench.noise.base import ScaledNoise


@dataclass(frozen=True)
class Colored(ScaledNoise):
    """First-order autoregressive noise, stationary: v_k = correlation v_(k-1) + sqrt(1 - correlation^2) deviation e_k.

    The readings are `channels` instruments in turn, each with a series of its own; after `length` readings of each the
    series start anew. GINS has 2 channels (the axes) and a length of 30 (the times of a case). `assumed` is what
    estimators are told: `white`, R = deviation^2 I, which is the mistake that the paper warns of; or `full`, the truth.
    """

    correlation: Annotated[float, Gt(-1), Lt(1)] = 0.5
    """Of successive readings of one instrument."""
    channels: Count = 1
    length: Count | None = None
    """Readings per instrument in one series; None: all of them."""
    assumed: Literal["white", "full"] = "white"

    def _series(self, m: int) -> tuple[int, int, int]:
        """How m readings divide: (series after one another, length, channels)."""
        length = m // self.channels if self.length is None else self.length
        if length == 0 or m % (length * self.channels):
            raise UserError(f"channels={self.channels}, length={self.length}: {m} readings do not divide into these")
        return m // (length * self.channels), length, self.channels

    @property
    def true_covariance(self) -> bool:
        return self.assumed == "full" or self.correlation == 0

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        e = rng.standard_normal(self._series(len(h)))
        v = np.empty_like(e)
        v[:, 0] = e[:, 0]
        fresh = np.sqrt(1 - self.correlation**2)
        for k in range(1, e.shape[1]):
            v[:, k] = self.correlation * v[:, k - 1] + fresh * e[:, k]
        return h + self.stated * v.ravel()

    def covariance(self, m: int) -> Covariance:
        repeats, length, channels = self._series(m)
        if self.assumed == "white":
            return Covariance(np.full(m, self.stated))
        apart = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
        series = np.kron(self.correlation**apart, np.eye(channels))
        return Covariance(np.linalg.cholesky(self.stated**2 * np.kron(np.eye(repeats), series)))


@dataclass(frozen=True)
class Correlated(ScaledNoise):
    """Gaussian errors of any covariance R.

    Either `matrix` is R, in squared units of the readings; or readings of one standard deviation come in blocks of
    `block` that follow one another and share an error, such that two of a block have the given correlation. `assumed`
    is what estimators are told: `full`, R itself; or `white`, its diagonal.
    """

    correlation: Annotated[float, Ge(0), Lt(1)] = 0.5
    """Of two readings of one block."""
    block: Count | None = None
    """Readings per block; None: all are one."""
    matrix: tuple[tuple[float, ...], ...] | None = None
    """R (m, m); where it is given, the three options above play no part."""
    assumed: Literal["white", "full"] = "full"

    def completed(self, usual: UsualNoise | None) -> Correlated:
        return self if self.matrix is not None else super().completed(usual)

    @property
    def true_covariance(self) -> bool:
        return self.assumed == "full"

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + _factor(self, len(h)) @ rng.standard_normal(len(h))

    def covariance(self, m: int) -> Covariance:
        full = Covariance(_factor(self, m))
        return full if self.assumed == "full" else Covariance(full.deviations)


@functools.lru_cache(maxsize=8)
def _factor(noise: Correlated, m: int) -> Array:
    """The lower Cholesky factor (m, m) of R."""
    if noise.matrix is None:
        block = m if noise.block is None else noise.block
        if m % block:
            raise UserError(f"block={block}: {m} readings do not divide into such blocks")
        within = (1 - noise.correlation) * np.eye(block) + noise.correlation
        R = noise.stated**2 * np.kron(np.eye(m // block), within)
    else:
        R = np.array(noise.matrix, dtype=float)
        if R.shape != (m, m) or not np.allclose(R, R.T):
            raise UserError(f"matrix: give a symmetric matrix of {m} x {m} numbers")
    try:
        return np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        raise UserError("matrix: is not a covariance: it is not positive definite") from None
