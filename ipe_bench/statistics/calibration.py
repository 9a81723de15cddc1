"""How a reported covariance lies, not only whether it does: where the truth falls under the Gaussian that was reported.

Under an honest one the probability integral transform of the truth is uniform; its empirical distribution function less
the uniform one is held against bands that it leaves anywhere with a stated probability (Säilynoja, Bürkner, Vehtari,
Stat. Comput. 32, 2022, after Talts et al., arXiv 1804.06788).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import bdtr, bdtrc, chdtri, gammaincinv, gammaln, ndtri

from ipe_bench.basics.linalg import Array
from ipe_bench.trials.thresholds import FEW, GATE, gate

LEVEL = 0.95
POINTS = np.arange(1, 100) / 100
"""Where the distribution functions are compared."""
INSIDE = "inside its bands"
_RESOLVED = 1e-9
"""Below it, one less a coverage is round-off: then the sum over the points bounds the probability."""
_LEAST_TAIL = 1e-13


# The simultaneous bands ----------------------------------------------------------------------------------------------


def covered(trials: int, tails: Array) -> Array:
    """The probability (bands,) that the counts of uniform draws below each of `POINTS` all keep both binomial tails
    above that band's tail (bands,).

    Exact: the counts are those of a Poisson process given its total (Moscovich and Nadler, Stat. Probab. Lett. 123,
    2017), whose steps are alike, so that one kernel carries them from each point to the next.
    """
    low, high = _allowed(trials, tails)
    first, last = low.min(axis=0), high.max(axis=0)
    width, reach = int((last - first).max()) + 1, int((last - np.append(0, first[:-1])).max()) + 1
    mean, size = trials / (len(POINTS) + 1), 1 << (width + reach).bit_length()
    kernel = np.fft.rfft(_poisson(np.arange(reach), mean), size)
    state, start = np.zeros((len(tails), width)), 0
    state[:, 0] = 1.0
    for i, lowest in enumerate(first.tolist()):
        moved = np.fft.irfft(np.fft.rfft(state, size) * kernel, size)[:, lowest - start : lowest - start + width]
        count = np.arange(lowest, lowest + width)
        state = np.where((count >= low[:, i, None]) & (count <= high[:, i, None]), moved, 0.0)
        start = lowest
    rest = _poisson(trials - start - np.arange(width), mean)
    return np.clip(state @ rest / _poisson(np.array([trials]), float(trials)), 0.0, 1.0)


def _poisson(count: Array, mean: float) -> Array:
    at = np.maximum(count, 0)
    return np.where(count >= 0, np.exp(at * np.log(mean) - mean - gammaln(at + 1.0)), 0.0)


def _allowed(trials: int, tails: Array) -> tuple[Array, Array]:
    """The least and the largest count (bands, points) both of whose binomial tails exceed the band's."""
    return least_count(trials, POINTS, tails[:, None]), trials - least_count(trials, 1 - POINTS, tails[:, None])


def least_count(trials: Any, p: Array, tail: Array) -> Array:
    """The least k with P(binomial <= k) > tail, by bisection: the inverses of libraries are off by one at ties."""
    shape = np.broadcast_shapes(np.shape(trials), p.shape, tail.shape)
    low, high = np.full(shape, -1), np.full(shape, trials)
    while (high - low > 1).any():
        middle = (low + high) // 2
        above = (middle >= 0) & (bdtr(np.maximum(middle, 0), trials, p) > tail * (1 + 1e-9))
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return high


@lru_cache(maxsize=64)
def pointwise_tail(trials: int, level: float = LEVEL) -> float:
    """The binomial tail beyond each point with which the band holds everywhere with probability `level`."""
    low, high = (1 - level) / (4 * len(POINTS)), 1 - level
    for _ in range(7):
        # Eight at once take little longer than one.
        tails = np.geomspace(low, high, 10)
        holds = covered(trials, tails[1:-1]) >= level
        k = int(holds.sum()) if holds.all() else int(np.argmin(holds))
        low, high = tails[k], tails[k + 1]
    return float(low)


@lru_cache(maxsize=64)
def band(trials: int, level: float = LEVEL) -> tuple[Array, Array]:
    """Ends (points,) of the band of the difference, which uniform draws leave anywhere in 1 - level of cases."""
    low, high = _allowed(trials, np.array([pointwise_tail(trials, level)]))
    return low[0] / trials - POINTS, high[0] / trials - POINTS


@dataclass(frozen=True)
class Curve:
    """An empirical distribution function less the uniform one, at `POINTS`."""

    trials: int
    difference: Array
    p: float
    """The probability that uniform draws go as far: leave the widest band that this curve does not keep within."""

    @property
    def leans(self) -> bool:
        """Whether it lies to one side."""
        low, high = sorted((abs(float(self.difference.min())), abs(float(self.difference.max()))))
        return low < high / 3

    @property
    def excursion(self) -> float:
        """The largest difference, with its sign."""
        return float(self.difference[np.argmax(np.abs(self.difference))])


def curves(below: Sequence[Array], trials: int) -> list[Curve]:
    """The curves of which so many of the trials, one or more, lie at each of `POINTS` or below."""
    counts = np.array(below)
    reached = np.where(counts > 0, bdtrc(np.maximum(counts - 1, 0), trials, POINTS), 1.0)
    tails = np.minimum(bdtr(counts, trials, POINTS), reached).min(axis=1)
    outside = 1 - covered(trials, np.maximum(tails, _LEAST_TAIL))
    p = np.where(outside > _RESOLVED, outside, np.minimum(2 * len(POINTS) * tails, _RESOLVED))
    return [Curve(trials, c / trials - POINTS, float(q)) for c, q in zip(counts, p, strict=True)]


# What an estimator claims --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Calibration:
    """The normalised errors of one parameter, or NEES of all together, as distribution functions with a verdict."""

    z: Array
    """(claims,), ascending: error over reported deviation, or the square root of NEES; infinite where the claim is
    void."""
    degrees: int
    """Of the chi-square law that z² has if the claims are true."""
    size: Curve
    """Of z² under that law."""
    place: Curve | None = None
    """Of the truth under the reported Gaussian of one parameter, whose errors have a sign."""

    @property
    def shown(self) -> Curve:
        """The curve that says most to the eye."""
        return self.place or self.size

    @property
    def p(self) -> float:
        """The probability of curves so far off if the claims are true; of two curves, twice the smaller."""
        return self.size.p if self.place is None else min(1.0, 2 * min(self.place.p, self.size.p))

    @property
    def excursion(self) -> float:
        """How far off the farther curve is anywhere, without sign."""
        return max(abs(c.excursion) for c in (self.place, self.size) if c is not None)

    def band(self, level: float) -> tuple[Array, Array]:
        """What `shown` is held against; where two curves share the level, each has half of what it leaves."""
        return band(len(self.z), level if self.place is None else (1 + level) / 2)

    def words(self, level: float) -> str:
        """What is wrong, if anything surely is: shift, scale and tails, each by order statistics, which no outlier
        moves. An estimate that is shifted by +1 deviations lies above the truth."""
        if self.p >= 1 - level:
            return INSIDE
        z, faults, middle = self.z, [], float(np.median(self.z))
        if self.place is not None and not _holds(median_limits(z, level), 0.0):
            faults.append(f"shifted by {_signed(middle)} deviations")
            z = z - middle
        usual = float(np.sqrt(2 * gammaincinv(self.degrees / 2, 0.5)))
        scale = float(np.median(np.abs(z))) / usual
        if not np.isfinite(scale):
            return "; ".join([*faults, "most reported covariances are void"])
        if not _holds(median_limits(np.abs(z) / usual, level), 1.0):
            faults.append(_scaled(scale))
        outside = int((np.abs(z) / max(scale, 1.0) > np.sqrt(gate(self.degrees))).sum())
        if outside and bdtrc(outside - 1, len(z), GATE) < 1 - level:
            faults.append(f"{100 * outside / len(z):.2g} % far outside")
        if faults:
            return "; ".join(faults)
        # No order statistic is sure by itself: the curve as a whole may still lie to one side.
        by_place = self.place is not None and self.place.p < self.size.p
        if not (self.shown if by_place else self.size).leans:
            return "of another shape"
        at = POINTS[np.argmax(np.abs(self.size.difference))]
        scale = float(np.quantile(np.abs(self.z), at) / np.sqrt(2 * gammaincinv(self.degrees / 2, at)))
        return f"shifted by {_signed(middle)} deviations" if by_place else _scaled(scale)


def calibrations(error: Array, deviation: Array, nees: Array, claimed: Array) -> list[Calibration]:
    """Of each parameter, and of all together last, over the trials that claim to know their covariance; empty where
    none does.

    error and deviation (trials, n), nees (trials,) and claimed (trials,) boolean. A deviation that is none, or 0, puts
    its truth infinitely far out; a trial whose NEES is not a number reports no covariance and claims nothing.
    """
    claimed = claimed & ~np.isnan(nees)
    if not claimed.any():
        return []
    n, trials = error.shape[1], int(claimed.sum())
    each = [_normalised(e[claimed], d[claimed]) for e, d in zip(error.T, deviation.T, strict=True)]
    together = np.sort(np.sqrt(nees[claimed]))
    # Each u is below a point where z is beyond that point's quantile: 99 quantiles are had sooner than every u.
    least, radius, whole = -ndtri(POINTS), np.sqrt(chdtri(1, 1 - POINTS)), np.sqrt(chdtri(n, 1 - POINTS))
    place = [trials - np.searchsorted(z, least) for z in each]
    size = [np.searchsorted(z, radius, side="right") - np.searchsorted(z, -radius) for z in each]
    found = curves([*place, *size, np.searchsorted(together, whole, side="right")], trials)
    parts = [Calibration(z, 1, found[n + i], found[i]) for i, z in enumerate(each)]
    return [*parts, Calibration(together, n, found[-1])]


def _normalised(e: Array, d: Array) -> Array:
    """The errors of one parameter over what is reported of them, ascending."""
    with np.errstate(all="ignore"):
        return np.sort(np.where(d > 0, e / d, np.copysign(np.inf, e)))


def overall_p(parts: Sequence[Calibration]) -> float:
    """The probability that any of the parts is so far off if all claims are true: Bonferroni's, which needs no
    independence."""
    return min(1.0, len(parts) * min(part.p for part in parts)) if parts else np.nan


def shared_level(parts: Sequence[Calibration], level: float = LEVEL) -> float:
    """The level of each part with which all of an honest estimator's keep within their bands in `level` of cases."""
    return 1 - (1 - level) / max(len(parts), 1)


def overall_words(parts: Sequence[Calibration], names: Sequence[str], level: float = LEVEL) -> str:
    """The verdict on an estimator by NEES and all its parameters at once."""
    if not parts:
        return "-"
    each = shared_level(parts, level)
    *outside, together = [part.words(each) for part in parts]
    outside = sorted(
        (part.p, -part.excursion, name, words)
        for part, name, words in zip(parts, names, outside, strict=False)
        if words != INSIDE
    )
    if not outside:
        return together
    *_, worst, words = outside[0]
    who = worst if len(outside) == 1 else f"{len(outside)} of {len(names)} parameters outside, most {worst}"
    return f"{'' if together == INSIDE else together + '; '}{who}: {words}"


def _holds(interval: tuple[float, float], value: float) -> bool:
    return interval[0] <= value <= interval[1]


def median_limits(values: Array, level: float = LEVEL) -> tuple[float, float]:
    """Interval of the median by order statistics, whatever the distribution; without ends below `FEW` values."""
    count = len(values)
    k = int(least_count(count, np.array([0.5]), np.array([(1 - level) / 2]))[0]) if count >= FEW else 0
    if k == 0:
        return -np.inf, np.inf
    ordered = np.partition(values, (k - 1, count - k))
    return float(ordered[k - 1]), float(ordered[count - k])


def _scaled(scale: float) -> str:
    """Errors that are `scale` times what is reported: two figures, three just above 1; of very many times the order."""
    if scale == 0:
        return "errors of 0"
    times, fault = (scale, "small") if scale > 1 else (1 / scale, "large")
    shown = f"{times:.1e}".replace("e+0", "e").replace("e+", "e")
    if times < 1e6:
        shown = f"{times:.2f}" if times < 1.095 else f"{times:.1f}" if times < 9.95 else f"{float(f'{times:.2g}'):,.0f}"
    return f"deviations {shown} times too {fault}"


def _signed(value: float) -> str:
    return f"{float(f'{value:.2g}'):+,g}".replace("-", "\N{MINUS SIGN}")
