"""Bounds the distance of a share, a root mean square error or a mean NEES from its true value.

Intervals are of a fixed number of trials; confidence sequences hold the true value at all numbers
of trials at once with the stated probability, so that one may look as often as one likes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from scipy.special import betaincinv, betaln, chdtri, ndtri

from ipe_bench.basics.linalg import Array, finite_or
from ipe_bench.basics.streams import generator
from ipe_bench.statistics.verdicts import (
    CONSISTENT,
    NO_VERDICT,
    NOT_REFUTED,
    OVERCONFIDENT,
    TOO_CAUTIOUS,
    UNDECIDED,
    Verdict,
)
from ipe_bench.trials.thresholds import FEW

LEVEL = 0.95
RESAMPLES = 2000
_LAST = 10
"""Resamples that an end of an interval leaves outside at least."""
LARGEST_SAMPLE = 2000
"""Above this many trials, groups of consecutive trials are resampled in their place."""
HEAVY = 0.01
"""Share of samples of normal errors that are taken for heavy-tailed ones."""
_ONE_TRIAL = 0.05
"""Share of one trial in the sum of squared squares above which their scatter is not known
either."""
TIGHTEST = 1000
"""The number of trials at which sequences are about as narrow as they can be; at others they are
valid as well."""
_SURPRISE = 2 * math.log(20)
_WEIGHT = TIGHTEST / (_SURPRISE + math.log(_SURPRISE) + 1)
"""Weight of the mixtures, in trials: it makes those of 95 % tightest there (Waudby-Smith et al.,
2024, appendix)."""
_HALVINGS = 50
UNUSUAL = 1e-3
"""Share of normal errors that are at least as large as one that counts as unusual."""
RARE = 10
"""Number of unusual trials from which a sample shows well enough what they are like."""
UNSEEN_NEES = 50.0
"""NEES over its degrees assumed in unseen trials: that of errors ten times larger in one trial of a
hundred, or of any size in one of fifty, where the covariance is right."""
EXCLUDED = 1.5
"""Factor of the variance that is excluded where a covariance is called consistent."""
VAGUE = 10.0
"""Factor of the variance above which trials that do not exclude it decide nothing."""
_FARTHEST = 40.0
"""Logarithm of the ratio to their mean below which nothing is sought."""
_BETS = 0.99 * 2.0 ** -np.arange(9)
"""Shares of the stake."""


# Shares -------------------------------------------------------------------------------------------


def clopper_pearson(count: int, trials: int, level: float = LEVEL) -> tuple[float, float]:
    """Computes the exact confidence interval of a share of which `count` in `trials` was seen
    (Clopper and Pearson, Biometrika 26, 1934)."""
    if trials < 1:
        return np.nan, np.nan
    tail = (1 - level) / 2
    low = 0.0
    if count:
        low = float(betaincinv(count, trials - count + 1, tail))
    high = 1.0
    if count < trials:
        high = float(betaincinv(count + 1, trials - count, 1 - tail))
    return low, high


# Root mean squares of a fixed number of trials ----------------------------------------------------


def rms_interval(
    squares: Array, used: Array | None = None, level: float = LEVEL
) -> tuple[Array, Array]:
    """Computes the bootstrap-t interval of the root mean square over the trials used, per column;
    NaN below `FEW`.

    squares is (trials, k), used (trials,) boolean, all where it is not given. The logarithm of the
    mean square is studentised (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch.
    12), which makes its variance nearly constant. Its standard error s is taken s times larger,
    since s comes out too small where few large errors carry the mean: by simulation, coverage is
    then 94 % or more from 20 trials on for errors from uniform to Student's t with 5 degrees.
    Trials are drawn with replacement, used or not; the draws are the same for every estimator. Of
    more than `LARGEST_SAMPLE` trials, groups of consecutive ones are drawn, which is as good since
    trials are independent.
    """
    if used is None:
        used = np.ones(len(squares), dtype=bool)
    sums = grouped(np.where(used, squares.T, 0.0))
    counts = grouped(used.astype(float)[None])
    if counts.sum() < FEW:
        unknown = np.full(sums.shape[1], np.nan)
        return unknown, unknown
    once = np.ones((1, len(counts)))
    with np.errstate(all="ignore"):
        # A sum of squares beside its own size: errors may be anything from 1e-200 to 1e200.
        size = sums.max(axis=0)
        scaled = np.where(size > 0, sums / size, 0.0)
        centre, error = _log_ratio(once, scaled, counts)
        drawn, drawn_error = _log_ratio(_draws(len(counts)), scaled, counts)
        t = np.where(drawn_error > 0, (drawn - centre) / drawn_error, 0.0)
        tail = (1 - level) / 2
        # Resamples have no quantiles beyond the last few of them: those are longer as a normal
        # law's are.
        seen = max(tail, _LAST / RESAMPLES)
        longer = ndtri(tail) / ndtri(seen)
        limits = np.quantile(t, [seen, 1 - seen], axis=0) * longer
        widened = error * (1 + error)
        # The upper limit of t makes the lower end: t = (drawn - centre) / s.
        ends = np.sqrt(size) * np.exp((centre - limits[::-1] * widened) / 2)
    low, high = np.where(size > 0, ends, 0.0)
    return low, high


def grouped(values: Array, groups: int = LARGEST_SAMPLE) -> Array:
    """Sums (groups, k) of values (k, trials) over groups of trials in succession, as alike as can
    be; the values themselves where there are no more trials than groups."""
    trials = values.shape[1]
    if trials > groups:
        starts = np.linspace(0, trials, groups, endpoint=False).astype(int)
        values = np.add.reduceat(values, starts, axis=1)
    return np.ascontiguousarray(values.T)


def _log_ratio(draws: Array, sums: Array, counts: Array) -> tuple[Array, Array]:
    """Computes the logarithm of sums over counts in each resample (resamples, k), and its standard
    error."""
    k = sums.shape[1]
    columns = np.hstack([sums, sums**2, sums * counts, counts, counts**2])
    # One product: a hundred columns take little longer than the way of the draws through memory.
    drawn = draws @ columns
    borders = [k, 2 * k, 3 * k, 3 * k + 1]
    total, squares, products, count, squared_count = np.split(drawn, borders, axis=1)
    ratio = total / count
    # The sum over trials of (square - ratio count)^2, multiplied out.
    scatter = squares - 2 * ratio * products + ratio**2 * squared_count
    number = len(counts)
    scatter = np.maximum(scatter, 0.0) * number / (number - 1)
    return np.log(ratio), np.sqrt(scatter) / total


@lru_cache(maxsize=4)
def _draws(size: int) -> Array:
    """Draws how often each of `size` items occurs in each resample: (RESAMPLES, size)."""
    rng = generator(size)
    alike = np.full(size, 1 / size)
    return rng.multinomial(size, alike, size=RESAMPLES).astype(float)


# Whether few trials carry a sum -------------------------------------------------------------------


@dataclass(frozen=True)
class Squares:
    """Holds squares relative to their largest: they may be anything from 1e-200 to 1e200, whose
    squares overflow."""

    count: int
    mean: Array
    """(k,)"""
    deviations: Array
    """(k,), sum of squared deviations from the mean."""

    @classmethod
    def of(cls, squares: Array) -> Squares:
        """Summarises squares (k, trials)."""
        count = squares.shape[1]
        if not count:
            nothing = np.zeros(len(squares))
            return cls(0, nothing, nothing)
        largest = squares.max(axis=1, keepdims=True)
        with np.errstate(all="ignore"):
            scaled = np.where(largest > 0, squares / largest, 0.0)
        mean = scaled.mean(axis=1)
        deviations = ((scaled - mean[:, None]) ** 2).sum(axis=1)
        return cls(count, mean, deviations)

    @property
    def effective(self) -> Array:
        """The effective number (k,) of those that share in the sum: its square over the sum of
        squares."""
        total = self.count * self.mean
        return total**2 / (self.deviations + total * self.mean)


def few_carry(squares: Squares, degrees: Array) -> Array:
    """Returns whether few trials carry the sum of squares (k,), so that no interval made of them
    can be relied on.

    `degrees` (k,) are those of the chi-square law that a square has for normal errors. The sum of
    squared shares of the trials is beyond what such errors exceed in a share `HEAVY` of cases, and
    one trial makes up a twentieth of it. Where none of the trials has a rare large error, nothing
    in them can tell.
    """
    with np.errstate(all="ignore"):
        shares = 1 / squares.effective
        largest = 1 / (squares.deviations + squares.count * squares.mean**2)
    limits = np.array([_heaviest(squares.count, int(d)) for d in degrees])
    return (shares > limits) & (largest > _ONE_TRIAL)


@lru_cache(maxsize=1024)
def _heaviest(trials: int, degrees: int) -> float:
    """Computes the quantile 1 - `HEAVY` of the sum of squared shares of so many independent
    chi-square numbers in their sum: that of the shifted lognormal law with its mean, variance and
    skewness, which are those of Dirichlet's."""
    if trials < 3:
        return np.inf
    a = Fraction(degrees, 2)

    def rising(x: Fraction, k: int) -> Fraction:
        """Computes x (x + 1) ... (x + k - 1)."""
        return math.prod((x + i for i in range(k)), start=Fraction(1))

    def moment(*powers: int) -> Fraction:
        """Computes the mean of a product of powers of shares that follow Dirichlet's law."""
        numerator = math.prod((rising(a, k) for k in powers), start=Fraction(1))
        return numerator / rising(trials * a, sum(powers))

    # Moments of the sum of squared shares: its powers have a term for each choice of trials.
    pairs = trials * (trials - 1)
    triples = pairs * (trials - 2)
    mean = trials * moment(2)
    square = trials * moment(4) + pairs * moment(2, 2)
    cube = trials * moment(6) + 3 * pairs * moment(4, 2) + triples * moment(2, 2, 2)
    deviation = float(square - mean**2) ** 0.5
    third = float(cube - 3 * mean * square + 2 * mean**3)
    skewness = third / deviation**3
    # w is exp(sigma^2) of the lognormal law of that skewness, the real root of
    # (w + 2)^2 (w - 1) = skewness^2.
    odd = skewness * (1 + skewness**2 / 4) ** 0.5
    root = (1 + skewness**2 / 2 + odd) ** (1 / 3)
    w = root + 1 / root - 1
    quantile = np.exp(-ndtri(HEAVY) * np.log(w) ** 0.5)
    beyond = float(quantile - w**0.5)
    return float(mean) + deviation * beyond / (w * (w - 1)) ** 0.5


# What no trial has shown --------------------------------------------------------------------------


def unseen(
    squares: Array, degrees: Array, least: float | Array = 0.0, level: float = LEVEL
) -> Array:
    """Computes the share (k,) of trials that may be unusual beyond those that are: the upper limit
    of Clopper and Pearson less the share seen, 0 from `RARE` unusual trials on; about 3 / N where N
    trials show none.

    A square, of squares (k, trials), is unusual beyond the quantile `UNUSUAL` of a chi-square law
    with `degrees` (k,), in a unit that gives the law the median of the squares and is no smaller
    than `least`. No resampling of trials knows of those that are unseen: where one error in a
    hundred is ten times larger, it misses the root mean square in half of the studies of 50 to 100
    trials.
    """
    count = squares.shape[1]
    if not count:
        return np.full(len(squares), np.nan)
    units = np.median(squares, axis=1) / chdtri(degrees, 0.5)
    limits = np.maximum(units, least) * chdtri(degrees, UNUSUAL)
    unusual = (squares > limits[:, None]).sum(axis=1)
    one_sided = 2 * level - 1
    most = [clopper_pearson(k, count, one_sided)[1] if k < RARE else 0.0 for k in unusual.tolist()]
    return np.maximum(np.array(most) - unusual / count, 0.0)


def capped_interval(squares: Array, degrees: Array, cap: float) -> tuple[Array, Array]:
    """Computes ends (k,) of the interval of the root mean square of errors that count at most
    `cap`, from their squares (k, trials) over `degrees` (k,), the bound being 1: as `rms_interval`,
    but the trials that may be `unseen` count `cap` at the upper end, in the place of efficient
    ones."""
    low, high = rms_interval(np.minimum(squares, cap**2).T)
    rare = unseen(squares, degrees, least=1 / degrees)
    with np.errstate(over="ignore"):
        # An unseen trial adds cap^2 in the place of 1, the square of an efficient one.
        high = np.sqrt(high**2 + rare * (cap**2 - 1))
    return low, np.minimum(cap, high)


# NEES ---------------------------------------------------------------------------------------------


def mean_limits(degrees: float, trials: int, level: float = LEVEL) -> tuple[float, float]:
    """Computes limits of the mean over `trials` of chi-square / degrees with probability `level`,
    if all is consistent.

    NEES has n degrees per trial, NIS as many as the trial has readings (Bar-Shalom, Li and
    Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sec. 5.4.2).
    """
    if trials < 1 or degrees < 1:
        return np.nan, np.nan
    tail = (1 - level) / 2
    total = degrees * trials
    low, high = chdtri(total, np.array([1 - tail, tail])) / total
    return float(low), float(high)


@dataclass(frozen=True)
class MeanNees:
    """Holds the mean of NEES / n with the interval from which the verdict is read."""

    claims: int
    """Trials that claim a covariance."""
    mean: float
    low: float
    """NaN for fewer than `FEW` claims, as the ends below."""
    high: float
    """The largest factor of the variance that these trials do not exclude."""
    with_unseen: float
    """The same with a NEES / n of `UNSEEN_NEES` in the share of trials that may be `unseen`;
    infinite where few trials carry the mean."""

    @property
    def verdict(self) -> Verdict:
        if self.claims < FEW:
            return NO_VERDICT
        if self.low > 1:
            return OVERCONFIDENT
        if self.high < 1:
            return TOO_CAUTIOUS if self.with_unseen < 1 else UNDECIDED
        if self.high > VAGUE:
            return UNDECIDED
        return CONSISTENT if self.high <= EXCLUDED else NOT_REFUTED


def mean_nees(nees: Array, n: int, level: float = LEVEL) -> MeanNees:
    """Computes the mean NEES / n of n parameters with its interval, from the NEES (trials,) of the
    trials that an estimator calls converged, as `scoring.nees` returns them.

    The upper end is that of root mean squares, whose width is the trials' own scatter: its factor
    is too small in 3 % of the studies of normal errors and 3 to 6 % of those of Student's t with 5
    degrees. Where it is not given for some of them, it is too small more often in the others. The
    lower end is by bets, for any law of the errors, or that of root mean squares, whichever is
    larger; by bets alone where few trials carry the mean. A trial whose NEES is NaN made no claim
    and is left out.
    """
    x = nees[~np.isnan(nees)] / n
    mean = float(np.mean(x)) if len(x) else np.nan
    if len(x) < FEW:
        return MeanNees(len(x), mean, np.nan, np.nan, np.nan)
    x = np.minimum(x, 1e150)
    low = _surely_above(x, level)
    degrees = np.array([n])
    # Of numbers in the place of squares, the ends are roots.
    (lower,), (upper,) = rms_interval(x[:, None], level=level)
    with np.errstate(over="ignore"):
        high = float(upper**2)
    if few_carry(Squares.of(x[None]), degrees)[0]:
        return MeanNees(len(x), mean, low, high, np.inf)
    (rare,) = unseen(x[None], degrees, level=level)
    with_unseen = float(high + rare * (UNSEEN_NEES - 1))
    return MeanNees(len(x), mean, max(low, float(lower**2)), high, with_unseen)


def verdict(nees: Array, n: int, level: float = LEVEL) -> Verdict:
    """Words the value of an estimator's own covariance; see `mean_nees`."""
    return mean_nees(nees, n, level).verdict


def _surely_above(x: Array, level: float) -> float:
    """Computes the largest number that the mean of nonnegative numbers (trials,) exceeds by bets;
    0 if they are 0."""
    middle = np.log(np.mean(x)) if x.any() else -np.inf
    if not np.isfinite(middle):
        return 0.0

    def is_exceeded(logarithm: float) -> bool:
        return _evidence_above_1(x / np.exp(logarithm)) >= 2 / (1 - level)

    return float(np.exp(first_that(is_exceeded, middle, middle - _FARTHEST)))


def _evidence_above_1(x: Array) -> float:
    """Computes the evidence that the mean of nonnegative numbers (trials,) is above 1, for any law:
    the mean fortune of those who bet fixed shares on it, which exceeds c with a probability of at
    most 1 / c otherwise."""
    gains = _BETS[:, None] * (x - 1)
    fortunes = np.log1p(gains).sum(axis=1)
    # Cut off before the exponential overflows.
    return float(np.mean(np.exp(np.minimum(fortunes, 600.0))))


# However often one looks --------------------------------------------------------------------------


def share_sequence(count: int, trials: int, level: float = LEVEL) -> tuple[float, float]:
    """Computes the confidence sequence of a share of which `count` in `trials` was seen: the hull
    of those p whose likelihood is not beaten by more than 1/(1 - level) by that of a share drawn
    from a Beta distribution about p.

    That ratio is a martingale under p, so by Ville's inequality it ever exceeds this bound with at
    most the probability 1 - level (Robbins, Ann. Math. Statist. 41, 1970; Howard, Ramdas, McAuliffe
    and Sekhon, Ann. Statist. 49, 2021).
    """
    if trials < 1:
        return np.nan, np.nan
    failures = trials - count

    def beaten(p: float) -> bool:
        # Shares drawn from Beta(a, b), with the mean p, give the count this likelihood.
        a = _WEIGHT * p
        b = _WEIGHT * (1 - p)
        mixture = float(betaln(a + count, b + failures) - betaln(a, b))
        own = 0.0
        if count:
            own += count * math.log(p)
        if failures:
            own += failures * math.log1p(-p)
        return mixture - own > -math.log(1 - level)

    seen = count / trials
    low = first_that(beaten, seen, 0.0) if count else 0.0
    high = first_that(beaten, seen, 1.0) if failures else 1.0
    return low, high


def first_that(holds: Callable[[float], bool], inside: float, outside: float) -> float:
    """Finds the first value, from inside to outside, at which a condition holds, by bisection."""
    for _ in range(_HALVINGS):
        middle = (inside + outside) / 2
        if middle in (inside, outside):
            break
        if holds(middle):
            outside = middle
        else:
            inside = middle
    return outside


# Quantiles ----------------------------------------------------------------------------------------


def quantile(values: Array, q: float) -> float:
    """Computes a quantile of non-negative numbers, linear between order statistics; non-finite ones
    are infinite."""
    if len(values) == 0:
        return np.nan
    position = (len(values) - 1) * q
    below = math.floor(position)
    above = math.ceil(position)
    ordered = np.partition(finite_or(np.inf, values), (below, above))
    a = ordered[below]
    b = ordered[above]
    # Between two infinite values nothing is interpolated: inf - inf is not a number.
    if not a < b:
        return float(a)
    return float(a + (b - a) * (position - below))


def quantiles(values: Array, q: Array) -> Array:
    """Computes many such quantiles (k, ...) along the first axis (trials, ...) from one sort."""
    ordered = np.sort(finite_or(np.inf, values), axis=0)
    position = (len(values) - 1) * q
    below = np.floor(position)
    a = ordered[below.astype(int)]
    b = ordered[np.ceil(position).astype(int)]
    beyond = (position - below).reshape(-1, *[1] * (values.ndim - 1))
    with np.errstate(invalid="ignore"):
        between = a + (b - a) * beyond
    return np.where(a < b, between, a)
