"""Tests the place of the truth under the Gaussian that an estimator reports.

Under the right one the probability integral transform of the truth is uniform; its empirical distribution function less
the uniform one is held against bands that it leaves anywhere with a stated probability (Säilynoja, Bürkner, Vehtari,
Stat. Comput. 32, 2022, after Talts et al., arXiv 1804.06788).
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
_RESOLVED = 1e-9
"""Below it, one less a coverage is round-off: then the sum over the points bounds the probability."""
_LEAST_TAIL = 1e-13


# The simultaneous bands ----------------------------------------------------------------------------------------------


def covered(trials: int, tails: Array) -> Array:
    """Computes the probability (bands,) that the counts of uniform draws below each of `POINTS` all keep both binomial
    tails above that band's tail (bands,).

    Exact: the counts are those of a Poisson process given its total (Moscovich and Nadler, Stat. Probab. Lett. 123,
    2017), whose steps are alike, so that one kernel carries them from each point to the next.
    """
    low, high = _allowed(trials, tails)
    first, last = low.min(axis=0), high.max(axis=0)
    width, reach = int((last - first).max()) + 1, int((last - np.append(0, first[:-1])).max()) + 1
    mean, size = trials / (len(POINTS) + 1), 1 << (width + reach).bit_length()
    kernel = np.fft.rfft(_poisson(np.arange(reach), mean), size)
    count = first[:, None] + np.arange(width)
    kept = ((count >= low[..., None]) & (count <= high[..., None])).transpose(1, 0, 2)
    state, start = np.zeros((len(tails), width)), 0
    state[:, 0] = 1.0
    for lowest, inside in zip(first.tolist(), kept, strict=True):
        moved = np.fft.irfft(np.fft.rfft(state, size) * kernel, size)
        state, start = moved[:, lowest - start : lowest - start + width] * inside, lowest
    rest = _poisson(trials - start - np.arange(width), mean)
    return np.clip(state @ rest / _poisson(np.array([trials]), float(trials)), 0.0, 1.0)


@lru_cache(maxsize=256)
def _covered_once(trials: int, tails: tuple[float, ...]) -> Array:
    """Computes the same once: estimators that agree have the same tails."""
    return covered(trials, np.array(tails))


def _poisson(count: Array, mean: float) -> Array:
    at = np.maximum(count, 0)
    return np.where(count >= 0, np.exp(at * np.log(mean) - mean - gammaln(at + 1.0)), 0.0)


def _allowed(trials: int, tails: Array) -> tuple[Array, Array]:
    """Returns the least and the largest count (bands, points) both of whose binomial tails exceed the band's."""
    least = least_count(trials, POINTS, tails[:, None])
    return least, trials - least[:, ::-1]  # the points lie symmetrically about 1/2


def least_count(trials: Any, p: Array, tail: Array) -> Array:
    """Finds the least k with P(binomial <= k) > tail, by bisection: inverses of libraries are off by one at ties."""
    shape = np.broadcast_shapes(np.shape(trials), p.shape, tail.shape)
    low, high = np.full(shape, -1), np.full(shape, trials)
    while (high - low > 1).any():
        middle = (low + high) // 2
        above = (middle >= 0) & (bdtr(np.maximum(middle, 0), trials, p) > tail * (1 + 1e-9))
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return high


@lru_cache(maxsize=64)
def band(trials: int, level: float = BAND_LEVEL) -> tuple[Array, Array]:
    """Ends (points,) of the band of the difference, which uniform draws leave anywhere in 1 - level of cases."""
    low, high = (1 - level) / (4 * len(POINTS)), 1 - level
    for _ in range(7):
        # Eight at once take little longer than one.
        tails = np.geomspace(low, high, 10)
        holds = covered(trials, tails[1:-1]) >= level
        k = int(holds.sum()) if holds.all() else int(np.argmin(holds))
        low, high = tails[k], tails[k + 1]
    least, most = _allowed(trials, np.array([low]))
    return least[0] / trials - POINTS, most[0] / trials - POINTS


@dataclass(frozen=True)
class Curve:
    """Holds an empirical distribution function less the uniform one, at `POINTS`."""

    difference: Array
    p: float
    """Probability that uniform draws deviate as far: that they leave the widest band that this curve leaves."""

    @property
    def excursion(self) -> float:
        return float(np.abs(self.difference).max())

    @property
    def leans(self) -> bool:
        """Whether it lies to one side."""
        low, high = sorted(np.abs([self.difference.min(), self.difference.max()]))
        return bool(low < high / 3)


def curves(below: Sequence[Array], trials: int) -> list[Curve]:
    """Computes the curves of which so many of the trials, one or more, lie at each of `POINTS` or below."""
    counts = np.array(below)
    reached = np.where(counts > 0, bdtrc(np.maximum(counts - 1, 0), trials, POINTS), 1.0)
    tails = np.minimum(bdtr(counts, trials, POINTS), reached).min(axis=1)
    outside = 1 - _covered_once(trials, tuple(np.maximum(tails, _LEAST_TAIL).tolist()))
    p = np.where(outside > _RESOLVED, outside, np.minimum(2 * len(POINTS) * tails, _RESOLVED))
    return [Curve(c / trials - POINTS, float(q)) for c, q in zip(counts, p, strict=True)]


# What an estimator claims --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Calibration:
    """Holds the normalised errors of one parameter, or NEES of all, as distribution functions with a verdict."""

    z: Array
    """(claims,), ascending: error over reported deviation, or the square root of NEES; infinite where the claim is
    void."""
    degrees: int
    """Degrees of the chi-square law that z² has if the claims are true."""
    level: float
    """Probability that true claims keep within these bands; over all bands of the estimator it is 95 %."""
    size: Curve
    """Distribution of z² under that law."""
    place: Curve | None = None
    """Distribution of the truth under the reported Gaussian of one parameter, whose errors have a sign."""

    @property
    def p(self) -> float:
        """The probability of curves so far off if the claims are true; of two curves, twice the smaller."""
        return self.size.p if self.place is None else min(1.0, 2 * min(self.place.p, self.size.p))

    @property
    def excursion(self) -> float:
        """Largest deviation of the farther curve."""
        return max(curve.excursion for curve in (self.place, self.size) if curve is not None)

    @cached_property
    def words(self) -> str:
        """Proven faults: shift, scale and tails, each by order statistics, which no outlier moves. An estimate that is
        shifted by +1 deviations lies above the truth."""
        if self.p >= 1 - self.level:
            return INSIDE
        z, faults, middle = self.z, [], float(np.median(self.z))
        if self.place is not None and not _holds(median_limits(z, self.level), 0.0):
            faults.append(_shifted(middle))
            z = z - middle
        sizes = np.abs(z) / np.sqrt(chdtri(self.degrees, 0.5))
        scale = float(np.median(sizes))
        if not np.isfinite(scale):
            return "; ".join([*faults, "most reported covariances are void"])
        if not _holds(median_limits(sizes, self.level), 1.0):
            faults.append(_scaled(scale))
        outside = int((np.abs(z) / max(scale, 1.0) > np.sqrt(gate(self.degrees))).sum())
        if outside and bdtrc(outside - 1, len(z), GATE) < 1 - self.level:
            faults.append(f"{100 * outside / len(z):.2g} % far outside")
        if faults:
            return "; ".join(faults)
        # No order statistic is sure by itself: the curve as a whole may still lie to one side.
        place = self.place if self.place is not None and self.place.p < self.size.p else None
        if not (place or self.size).leans:
            return "of another shape"
        at = POINTS[np.argmax(np.abs(self.size.difference))]
        usual = float(np.sqrt(chdtri(self.degrees, 1 - at)))
        return (
            _shifted(middle) if place else _scaled(float(np.quantile(np.abs(self.z), at)) / usual)
        )


def calibrations(error: Array, deviation: Array, nees: Array, claimed: Array) -> list[Calibration]:
    """Computes the calibration of each parameter, and of all together last, over the trials that claim to know their
    covariance; empty if none does.

    error and deviation (trials, n), nees (trials,) and claimed (trials,) boolean. A deviation that is none, or 0, puts
    its truth infinitely far out; a trial whose NEES is not a number reports no covariance and claims nothing.
    """
    claimed = claimed & ~np.isnan(nees)
    if not claimed.any():
        return []
    n, trials = error.shape[1], int(claimed.sum())
    each = [_normalised(e[claimed], s[claimed]) for e, s in zip(error.T, deviation.T, strict=True)]
    together = np.sort(np.sqrt(nees[claimed]))
    # Each u is below a point where z is beyond that point's quantile: 99 quantiles are had sooner than every u.
    least, radius, whole = (
        -ndtri(POINTS),
        np.sqrt(chdtri(1, 1 - POINTS)),
        np.sqrt(chdtri(n, 1 - POINTS)),
    )
    place = [trials - np.searchsorted(z, least) for z in each]
    size = [np.searchsorted(z, radius, side="right") - np.searchsorted(z, -radius) for z in each]
    found = curves([*place, *size, np.searchsorted(together, whole, side="right")], trials)
    level = 1 - (1 - BAND_LEVEL) / (n + 1)
    parts = [Calibration(z, 1, level, found[n + i], found[i]) for i, z in enumerate(each)]
    return [*parts, Calibration(together, n, level, found[-1])]


def _normalised(error: Array, deviation: Array) -> Array:
    """Computes errors over reported deviations, ascending (claims,)."""
    with np.errstate(all="ignore"):
        return np.sort(np.where(deviation > 0, error / deviation, np.copysign(np.inf, error)))


def overall_words(parts: Sequence[Calibration], names: Sequence[str]) -> str:
    """Words the verdict on an estimator: what is wrong with NEES, and with the parameter that is farthest off."""
    if not parts:
        return "-"
    *said, together = [part.words for part in parts]
    outside = [k for k, words in enumerate(said) if words != INSIDE]
    if not outside:
        return together
    worst = min(outside, key=lambda k: (parts[k].p, -parts[k].excursion, names[k]))
    others = (
        "" if len(outside) == 1 else f"{len(outside)} of {len(names)} parameters outside, most "
    )
    return f"{'' if together == INSIDE else together + '; '}{others}{names[worst]}: {said[worst]}"


def _holds(interval: tuple[float, float], value: float) -> bool:
    return interval[0] <= value <= interval[1]


def median_limits(values: Array, level: float = BAND_LEVEL) -> tuple[float, float]:
    """Computes the interval of the median by order statistics, for any law; without ends below `FEW` values."""
    count = len(values)
    k = _rank(count, level) if count >= FEW else 0
    if k == 0:
        return -np.inf, np.inf
    ordered = np.partition(values, (k - 1, count - k))
    return float(ordered[k - 1]), float(ordered[count - k])


@lru_cache(maxsize=256)
def _rank(count: int, level: float) -> int:
    """Finds the place from either end of the values that bound the median of `count`."""
    return int(least_count(count, np.array([0.5]), np.array([(1 - level) / 2]))[0])


def _scaled(scale: float) -> str:
    """Words that the median error is `scale` times what is reported: two figures, three just above 1; of large ones the
    order. Where tails are heavy most are smaller though the variance is right."""
    if scale == 0:
        return "errors of 0"
    times, fault = (scale, "larger") if scale > 1 else (1 / scale, "smaller")
    shown = f"{times:.1e}".replace("e+0", "e").replace("e+", "e")
    if times < 1e6:
        shown = (
            f"{times:.2f}"
            if times < 1.095
            else f"{times:.1f}"
            if times < 9.95
            else f"{float(f'{times:.2g}'):,.0f}"
        )
    return f"most errors {shown} times {fault} than claimed"


def _shifted(middle: float) -> str:
    return f"shifted by {float(f'{middle:.2g}'):+,g} deviations".replace("-", "\N{MINUS SIGN}")
