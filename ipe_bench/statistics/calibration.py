"""Tests the place of the truth under the Gaussian that an estimator reports.

Under the right one the probability integral transform of the truth is uniform; its empirical
distribution function less the uniform one is held against bands that it leaves anywhere with a
stated probability (Säilynoja, Bürkner, Vehtari, Stat. Comput. 32, 2022, after Talts et al., arXiv
1804.06788).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.special import bdtr, bdtrc, chdtri, gammaln, ndtri

from ipe_bench.basics.linalg import Array
from ipe_bench.trials.thresholds import FEW, GATE, gate

BAND_LEVEL = 0.95
POINTS = np.arange(1, 100) / 100
"""Probabilities at which the distribution functions are compared."""
INSIDE = "inside its bands"
OTHER_SHAPE = "of another shape"
_RESOLVED = 1e-9
"""Below it, one less a coverage is round-off: then the sum over the points bounds the
probability."""
_LEAST_TAIL = 1e-13


# The simultaneous bands ---------------------------------------------------------------------------


def covered(trials: int, tails: Array) -> Array:
    """Computes the probability (bands,) that the counts of uniform draws below each of `POINTS` all
    keep both binomial tails above that band's tail (bands,).

    Exact: the counts are those of a Poisson process given its total (Moscovich and Nadler, Stat.
    Probab. Lett. 123, 2017), whose steps are alike, so that one kernel carries them from each point
    to the next.
    """
    low, high = _allowed(trials, tails)
    # At each point, the state is the probability of every count in a window that holds all bands'.
    first = low.min(axis=0)
    last = high.max(axis=0)
    steps = last - np.append(0, first[:-1])
    width = int((last - first).max()) + 1
    reach = int(steps.max()) + 1
    mean = trials / (len(POINTS) + 1)
    # A transform of so many numbers holds the convolution without wrapping around.
    size = 1 << (width + reach).bit_length()
    kernel = np.fft.rfft(_poisson(np.arange(reach), mean), size)
    count = first[:, None] + np.arange(width)
    allowed = (count >= low[..., None]) & (count <= high[..., None])
    state = np.zeros((len(tails), width))
    state[:, 0] = 1.0
    start = 0
    for lowest, inside in zip(first.tolist(), allowed.transpose(1, 0, 2), strict=True):
        moved = np.fft.irfft(np.fft.rfft(state, size) * kernel, size)
        ahead = lowest - start
        # What left its band is lost for good.
        state = moved[:, ahead : ahead + width] * inside
        start = lowest
    # The draws above the last point, then the condition that all are as many as the trials.
    rest = _poisson(trials - start - np.arange(width), mean)
    total = _poisson(np.array([trials]), float(trials))
    return np.clip(state @ rest / total, 0.0, 1.0)


@lru_cache(maxsize=256)
def _covered_once(trials: int, tails: tuple[float, ...]) -> Array:
    """Computes the same once: estimators that agree have the same tails."""
    return covered(trials, np.array(tails))


def _poisson(count: Array, mean: float) -> Array:
    """Computes the probability of counts under Poisson's law; 0 of those below 0."""
    at = np.maximum(count, 0)
    logarithm = at * np.log(mean) - mean - gammaln(at + 1.0)
    return np.where(count >= 0, np.exp(logarithm), 0.0)


def _allowed(trials: int, tails: Array) -> tuple[Array, Array]:
    """Returns the least and the largest count (bands, points) both of whose binomial tails exceed
    the band's."""
    least = least_count(trials, POINTS, tails[:, None])
    # The points lie symmetrically about 1/2.
    return least, trials - least[:, ::-1]


def least_count(trials: Any, p: Array, tail: Array) -> Array:
    """Finds the least k with P(binomial <= k) > tail, by bisection: inverses of libraries are off
    by one at ties."""
    shape = np.broadcast_shapes(np.shape(trials), p.shape, tail.shape)
    low = np.full(shape, -1)
    high = np.full(shape, trials)
    beyond = tail * (1 + 1e-9)
    while (high - low > 1).any():
        middle = (low + high) // 2
        # What is -1 has no tail; it comes up where `low` and `high` have met.
        below = bdtr(np.maximum(middle, 0), trials, p)
        above = (middle >= 0) & (below > beyond)
        low = np.where(above, low, middle)
        high = np.where(above, middle, high)
    return high


@lru_cache(maxsize=64)
def band(trials: int, level: float = BAND_LEVEL) -> tuple[Array, Array]:
    """Ends (points,) of the band of the difference, which uniform draws leave anywhere in 1 - level
    of cases."""
    # The tail lies between Bonferroni's over all points and ends, and that of one point.
    low = (1 - level) / (4 * len(POINTS))
    high = 1 - level
    for _ in range(7):
        # Eight at once take little longer than one.
        tails = np.geomspace(low, high, 10)
        holds = covered(trials, tails[1:-1]) >= level
        # The last tail in succession whose band holds, and the next.
        k = len(holds) if holds.all() else int(np.argmin(holds))
        low = tails[k]
        high = tails[k + 1]
    least, most = _allowed(trials, np.array([low]))
    return least[0] / trials - POINTS, most[0] / trials - POINTS


@dataclass(frozen=True)
class Curve:
    """Holds an empirical distribution function less the uniform one, at `POINTS`."""

    difference: Array
    p: float
    """Probability that uniform draws deviate as far: that they leave the widest band that this
    curve leaves."""

    @property
    def excursion(self) -> float:
        return float(np.abs(self.difference).max())

    @property
    def leans(self) -> bool:
        """Whether it lies to one side."""
        below = abs(self.difference.min())
        above = abs(self.difference.max())
        return bool(min(below, above) < max(below, above) / 3)


def curves(below: Sequence[Array], trials: int) -> list[Curve]:
    """Computes the curves of which so many of the trials, one or more, lie at each of `POINTS` or
    below."""
    counts = np.array(below)
    at_most = bdtr(counts, trials, POINTS)
    at_least = np.where(counts > 0, bdtrc(np.maximum(counts - 1, 0), trials, POINTS), 1.0)
    # The band that a curve just leaves has the smallest of its tails.
    tails = np.minimum(at_most, at_least).min(axis=1)
    covered_by = _covered_once(trials, tuple(np.maximum(tails, _LEAST_TAIL).tolist()))
    outside = 1 - covered_by
    bonferroni = np.minimum(2 * len(POINTS) * tails, _RESOLVED)
    p = np.where(outside > _RESOLVED, outside, bonferroni)
    return [Curve(c / trials - POINTS, float(q)) for c, q in zip(counts, p, strict=True)]


# What an estimator claims -------------------------------------------------------------------------


@dataclass(frozen=True)
class Calibration:
    """Holds the normalised errors of one parameter, or NEES of all, as distribution functions with
    a verdict."""

    z: Array
    """(claims,), ascending: error over reported deviation, or the square root of NEES; infinite
    where the claim is void."""
    degrees: int
    """Degrees of the chi-square law that z² has if the claims are true."""
    level: float
    """Probability that true claims keep within these bands; over all bands of the estimator it is
    95 %."""
    size: Curve
    """Distribution of z² under that law."""
    place: Curve | None = None
    """Distribution of the truth under the reported Gaussian of one parameter, whose errors have a
    sign."""

    @property
    def p(self) -> float:
        """The probability of curves so far off if the claims are true; of two curves, twice the
        smaller."""
        if self.place is None:
            return self.size.p
        return min(1.0, 2 * min(self.place.p, self.size.p))

    @property
    def excursion(self) -> float:
        """Largest deviation of the farther curve."""
        if self.place is None:
            return self.size.excursion
        return max(self.place.excursion, self.size.excursion)

    @cached_property
    def words(self) -> str:
        """Proven faults: shift, scale and tails, each by order statistics, which no outlier moves.
        An estimate that is shifted by +1 deviations lies above the truth."""
        if self.p >= 1 - self.level:
            return INSIDE
        z = self.z
        faults = []
        middle = float(np.median(self.z))
        if self.place is not None and not _holds(median_limits(z, self.level), 0.0):
            faults.append(_shifted(middle))
            z = z - middle
        # Sizes have the median 1 if the claims are true, since z² has the chi-square law.
        sizes = np.abs(z) / np.sqrt(chdtri(self.degrees, 0.5))
        scale = float(np.median(sizes))
        if not np.isfinite(scale):
            return "; ".join([*faults, "most reported covariances are void"])
        if not _holds(median_limits(sizes, self.level), 1.0):
            faults.append(_scaled(scale))
        outside = self._far_outside(np.abs(z) / max(scale, 1.0))
        if outside:
            faults.append(f"{100 * outside / len(z):.2g} % far outside")
        return "; ".join(faults) if faults else self._leaning(middle)

    def _far_outside(self, sizes: Array) -> int:
        """Counts the claims beyond the gate; 0 where true claims may have as many beyond it."""
        outside = int((sizes > np.sqrt(gate(self.degrees))).sum())
        if not outside:
            return 0
        chance = bdtrc(outside - 1, len(sizes), GATE)
        return outside if chance < 1 - self.level else 0

    def _leaning(self, middle: float) -> str:
        """Words to which side the farther curve lies as a whole, where no order statistic is sure
        by itself."""
        if self.place is not None and self.place.p < self.size.p:
            return _shifted(middle) if self.place.leans else OTHER_SHAPE
        if not self.size.leans:
            return OTHER_SHAPE
        at = POINTS[np.argmax(np.abs(self.size.difference))]
        found = float(np.quantile(np.abs(self.z), at))
        usual = float(np.sqrt(chdtri(self.degrees, 1 - at)))
        return _scaled(found / usual)


def calibrations(error: Array, deviation: Array, nees: Array, claimed: Array) -> list[Calibration]:
    """Computes the calibration of each parameter, and of all together last, over the trials that
    claim to know their covariance; empty if none does.

    error and deviation (trials, n), nees (trials,) and claimed (trials,) boolean. A deviation that
    is none, or 0, puts its truth infinitely far out; a trial whose NEES is not a number reports no
    covariance and claims nothing.
    """
    claimed = claimed & ~np.isnan(nees)
    if not claimed.any():
        return []
    n = error.shape[1]
    trials = int(claimed.sum())
    each = [_normalised(e[claimed], s[claimed]) for e, s in zip(error.T, deviation.T, strict=True)]
    together = np.sort(np.sqrt(nees[claimed]))
    # The probability integral transform u lies below a point where z lies beyond that point's
    # quantile: 99 quantiles are had sooner than every u.
    least = -ndtri(POINTS)
    place = [trials - np.searchsorted(z, least) for z in each]
    radius = np.sqrt(chdtri(1, 1 - POINTS))
    size = [np.searchsorted(z, radius, side="right") - np.searchsorted(z, -radius) for z in each]
    radius_of_all = np.sqrt(chdtri(n, 1 - POINTS))
    size_of_all = np.searchsorted(together, radius_of_all, side="right")
    found = curves([*place, *size, size_of_all], trials)
    level = 1 - (1 - BAND_LEVEL) / (n + 1)
    parts = [Calibration(z, 1, level, found[n + i], found[i]) for i, z in enumerate(each)]
    return [*parts, Calibration(together, n, level, found[-1])]


def _normalised(error: Array, deviation: Array) -> Array:
    """Computes errors over reported deviations, ascending (claims,)."""
    infinite = np.copysign(np.inf, error)
    with np.errstate(all="ignore"):
        z = np.where(deviation > 0, error / deviation, infinite)
    return np.sort(z)


def overall_words(parts: Sequence[Calibration], names: Sequence[str]) -> str:
    """Words the verdict on an estimator: what is wrong with NEES, and with the parameter that is
    farthest off."""
    if not parts:
        return "-"
    *said, together = [part.words for part in parts]
    outside = [k for k, words in enumerate(said) if words != INSIDE]
    if not outside:
        return together
    worst = min(outside, key=lambda k: (parts[k].p, -parts[k].excursion, names[k]))
    words = f"{names[worst]}: {said[worst]}"
    if len(outside) > 1:
        words = f"{len(outside)} of {len(names)} parameters outside, most {words}"
    return words if together == INSIDE else f"{together}; {words}"


def _holds(interval: tuple[float, float], value: float) -> bool:
    return interval[0] <= value <= interval[1]


def median_limits(values: Array, level: float = BAND_LEVEL) -> tuple[float, float]:
    """Computes the interval of the median by order statistics, for any law; without ends below
    `FEW` values."""
    count = len(values)
    k = _rank(count, level) if count >= FEW else 0
    if k == 0:
        return -np.inf, np.inf
    low = k - 1
    high = count - k
    ordered = np.partition(values, (low, high))
    return float(ordered[low]), float(ordered[high])


@lru_cache(maxsize=256)
def _rank(count: int, level: float) -> int:
    """Finds the place from either end of the values that bound the median of `count`."""
    (rank,) = least_count(count, np.array([0.5]), np.array([(1 - level) / 2]))
    return int(rank)


def _scaled(scale: float) -> str:
    """Words that the median error is `scale` times what is reported: two figures, three just above
    1; of large ones the order. Where tails are heavy most are smaller though the variance is
    right."""
    if scale == 0:
        return "errors of 0"
    if scale > 1:
        return f"most errors {_times(scale)} times larger than claimed"
    return f"most errors {_times(1 / scale)} times smaller than claimed"


def _times(number: float) -> str:
    if number >= 1e6:
        return f"{number:.1e}".replace("e+0", "e").replace("e+", "e")
    if number >= 9.95:
        return f"{float(f'{number:.2g}'):,.0f}"
    return f"{number:.1f}" if number >= 1.095 else f"{number:.2f}"


def _shifted(middle: float) -> str:
    return f"shifted by {float(f'{middle:.2g}'):+,g} deviations".replace("-", "\N{MINUS SIGN}")
