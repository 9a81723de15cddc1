"""Student's t, by which few readings may lie far away: for filters a mixture of normal
distributions, for paths a cost that hardly grows with what is far away.

Numbers of t have the variance of their reading, unless a scale is named.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, ndtr, ndtri

from ipe_bench.basics.linalg import Array
from ipe_bench.engine.scan import dot

_STEP = 0.9
"""Step between the normal distributions of a mixture, in deviations of the logarithm of their
precision: the density is then right to 1e-5."""
_LEAST = 1e-8
"""The least precision in the mixture, which is that of readings 10,000 deviations away."""
_RARE = 1e-9
"""Share below which the most precise ones are left out."""
_NONE = 1e-300
"""The least probability that has a normal score."""

Number = Any


class Mixture(NamedTuple):
    """Holds the normal distributions of which one of unit variance is made."""

    shares: tuple[float, ...]
    variances: tuple[float, ...]

    @property
    def least(self) -> float:
        """The least variance."""
        return min(self.variances)


@functools.cache
def mixture(degrees: float) -> Mixture:
    """Returns t of so many degrees of freedom as N(0, 1) of each precision l that is chi-square
    over degrees: the density of log l is l^(nu/2) exp(-l nu/2), up to a factor."""
    if math.isinf(degrees):
        return Mixture((1.0,), (1.0,))
    half = degrees / 2
    step = _STEP * math.sqrt(1 / (half + 0.5))
    u = np.arange(math.log(_LEAST), math.log(40.0), step)
    p = np.exp(half * (u + 1 - np.exp(u)))
    p /= p.sum()
    kept = (p > _RARE) | (u < 0)
    variances = (degrees - 2) / degrees * np.exp(-u)
    return Mixture(tuple(p[kept].tolist()), tuple(variances[kept].tolist()))


class Evidence(NamedTuple):
    """Holds what a reading tells whose noise is a mixture."""

    gain: Number
    """The mean a of 1/s, over the variances s of the innovation that it may have."""
    left: Number
    """What is left of the state's variance beside that of a reading without noise, in parts of its
    squared covariance with the innovation."""
    density: Number
    """The logarithm of the density of the innovation."""


def evidence(y: Number, v: Number, R: Number, parts: Mixture) -> Evidence:
    """Computes what an innovation y tells of normal states that give it the variance v, with the
    least noise; R is that of the reading (Masreliez, IEEE TAC 20, 1975: the posterior mean and
    covariance are exact, the latter with the distances of the means that y may stand for)."""
    further = [R * (one - parts.least) for one in parts.variances]
    s = [v + one for one in further]
    squares = [y * y / one for one in s]
    least = reduce(np.minimum, squares)
    p = []
    for share, one, square in zip(parts.shares, s, squares, strict=True):
        p.append(share / np.sqrt(one) * np.exp(0.5 * (least - square)))
    total = reduce(np.add, p)
    inverse = [1 / one for one in s]
    shares = [one / total for one in p]
    gain = dot(shares, inverse)
    by_noise = dot(shares, [a * b for a, b in zip(further, inverse, strict=True)])
    apart = dot(shares, [(one - gain) * (one - gain) for one in inverse])
    density = np.log(total) - 0.5 * (least + math.log(2 * math.pi))
    return Evidence(gain, gain * by_noise + y * y * apart, density)


def scores(y: Array, v: Array, R: Array, parts: Mixture) -> Array:
    """Computes the normal numbers that are as probable as innovations."""
    return as_normal(tail(-np.abs(y), v, R, parts), y)


def tail(y: Array, v: Array, R: Array, parts: Mixture) -> Array:
    """Computes how probable innovations below y are."""
    below = np.zeros(y.shape)
    for share, one in zip(parts.shares, parts.variances, strict=True):
        below += share * ndtr(y / np.sqrt(v + R * (one - parts.least)))
    return below


def as_normal(p: Array, sign: Array) -> Array:
    """Returns normal numbers of which those farther out have the probability p, with these
    signs."""
    return np.copysign(-ndtri(np.maximum(p, _NONE)), sign)


class Tails(NamedTuple):
    """Holds the noise of the readings of an epoch, of which some may be normal."""

    degrees: NDArray[np.float64]
    """(m,); infinite of normal readings."""

    @classmethod
    def of(cls, degrees: Sequence[float]) -> Tails | None:
        return cls(np.array(degrees)) if degrees else None

    @property
    def scale(self) -> Array:
        """The squared scales (m,) of t of unit variance."""
        return 1 - 2 / self.degrees

    @property
    def information(self) -> Array:
        """Variances (m,) of normal readings that tell as much as t of unit variance on average."""
        return self.scale * (1 + 2 / (self.degrees + 1))

    @property
    def _finite(self) -> Array:
        return np.where(np.isinf(self.degrees), 1.0, self.degrees)

    def costs(self, v: Array) -> Array:
        """Computes -2 log p (..., m) of residuals v in scales, less that of 0."""
        nu = self._finite
        return np.where(np.isinf(self.degrees), v**2, (nu + 1) * np.log1p(v**2 / nu))

    def alike(self, v: Array) -> Array:
        """Computes the same in parts of its mean: chi-square with a degree, as about; that of t is
        -(nu + 1) log of a beta variable."""
        nu = self._finite
        mean = (nu + 1) * (digamma((nu + 1) / 2) - digamma(nu / 2))
        return self.costs(v) / np.where(np.isinf(self.degrees), 1.0, mean)

    def weights(self, v: Array) -> Array:
        """Computes the weights (..., m) of squared residuals, in scales, whose sum has the slope of
        the costs."""
        nu = self._finite
        return np.where(np.isinf(self.degrees), 1.0, (nu + 1) / (nu + v**2))

    def curvatures(self, v: Array) -> Array:
        """Computes half the second derivatives of the costs, or 0 where they fall."""
        nu = self._finite
        curved = (nu + 1) * np.maximum(nu - v**2, 0.0) / (nu + v**2) ** 2
        return np.where(np.isinf(self.degrees), 1.0, curved)
