"""Compares two columns of numbers of the same trials: effects with intervals, evidence that allows
repeated looks, and the number of trials that a difference of success takes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import bdtr, betaln, ndtri

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.streams import generator
from ipe_bench.statistics.calibration import least_count
from ipe_bench.statistics.comparisons import ALPHA, differences, mcnemar
from ipe_bench.statistics.intervals import RARE, clopper_pearson, first_that, grouped
from ipe_bench.trials.thresholds import FEW

FLIPS = 4999
"""Random assignments of signs."""
MOST_SIGNS = 1000
"""Largest number of signs; in more trials, consecutive ones share a sign: as good, since they are
independent."""
_TILTS = np.concatenate([-(2.0 ** np.arange(-12, 5)), 2.0 ** np.arange(-12, 5)])
"""Multiples of the inverse unit by which differences are tilted, to either side."""
LIMIT = 0.8
"""Confidence of the upper limit of the discordant share: a plan by the share that a pilot shows is
too small as often as not."""
MOST = 10_000_000
"""Plans end at this many trials."""
_SAW = 20
"""Trials over which the power, which is a saw in their number, must stay."""
PLANNED = ("power", "difference", "discordant", "discordant_high", "trials_needed")
"""The columns that a plan adds to a row on success."""


@dataclass(frozen=True)
class Effect:
    """Holds the advantage of the second over the first, with interval, the p of no effect, and the
    evidence."""

    first_value: float
    second_value: float
    change: float
    """A ratio or a difference, as the function that made it says."""
    low: float = np.nan
    high: float = np.nan
    p: float = np.nan
    e: float = np.nan
    """An e-value: by chance it exceeds 1/alpha, at whatever number of trials one looks, in a share
    alpha of cases."""


# Effects -----------------------------------------------------------------------------------------


def success_effect(first: Array, second: Array, alpha: float = ALPHA) -> Effect:
    """Computes the difference of two shares of the same trials (trials,), second less first.

    The p is McNemar's exact one: given their number, the trials in which one alone succeeds are
    fair coin tosses. The interval is Tango's (Stat. Med. 17, 1998), of the score; it is widened to
    hold 0 where the exact test does not reject.
    """
    losses = int((first & ~second).sum())
    gains = int((second & ~first).sum())
    trials = len(first)
    p = mcnemar(losses, gains)
    low = _tango(losses, gains, trials, alpha)
    high = -_tango(gains, losses, trials, alpha)
    # The exact test has the last word on a difference of 0.
    if p >= alpha:
        low = min(low, 0.0)
        high = max(high, 0.0)
    change = (gains - losses) / trials
    return Effect(*_means(first, second), change, low, high, p, fair_coin(losses, gains))


def _means(first: Array, second: Array) -> tuple[float, float]:
    return float(first.mean()), float(second.mean())


def _tango(losses: int, gains: int, trials: int, alpha: float) -> float:
    """Finds the least difference of shares at which the score, with the likeliest shares of that
    difference, is not beyond the normal quantile."""
    quantile = -float(ndtri(alpha / 2))

    def inside(difference: float) -> bool:
        # The likeliest share q of losses at the difference d: 2 N q^2 - b q = losses d (1 - d).
        b = losses + gains + difference * (gains - losses - 2 * trials)
        c = 8 * trials * losses * difference * (1 - difference)
        root = np.sqrt(max(b * b + c, 0.0))
        lost = (b + root) / (4 * trials)
        # The score is (gains - losses - N d) / sqrt(N (2 q + d (1 - d))).
        variance = 2 * lost + difference * (1 - difference)
        deviation = np.sqrt(trials * max(variance, 0.0))
        return bool(gains - losses - trials * difference <= quantile * deviation)

    return first_that(inside, -1.0, (gains - losses) / trials)


def ratio_effect(
    first: Array, second: Array, alpha: float = ALPHA, largest: float | None = None
) -> Effect:
    """Computes the ratio of the means of two columns (trials,) of finite nonnegative numbers,
    second over first.

    Where neither is larger by nature, each trial's difference is as likely to have the other sign:
    the p is the share of random signs whose sum is as far from 0 (Fisher, The Design of
    Experiments, 1935, sec. 21), the interval holds the ratios r that the same test does not reject
    for second less r times first. An end that no ratio reaches is 0 or infinite.

    Where nearly all trials have one ratio, signs say nothing of the others, which are rare and
    perhaps unseen: the interval is widened by the share of trials that may differ beyond those that
    did (the upper limit of Clopper and Pearson), each by `largest`, the largest difference there
    can be; None: the largest number seen. It is never widened over a ratio of 1 that the test
    rejects.
    """
    signed = _Signed.of(first, second)
    means = _means(first, second)
    p_equal = signed.p(1.0)
    # The first trial is the unit: whoever looks later divides by the same.
    evidence = no_lean(second - first, float(first[0] + second[0]) or 1.0)
    total_a = float(signed.a.sum())
    total_b = float(signed.b.sum())
    if not total_a > 0:
        return Effect(*means, np.nan, p=p_equal, e=evidence)
    value = total_b / total_a
    if not total_b > 0:
        return Effect(*means, value, p=p_equal, e=evidence)

    # What the test does not reject of a over b is the inverse of what it does not of b over a.
    low = signed.least_ratio(alpha)
    inverse = signed.swapped.least_ratio(alpha)
    high = 1 / inverse if inverse > 0 else np.inf
    unseen = _unseen(first, second, alpha)
    if unseen:
        seen = max(first.max(), second.max())
        reach = unseen * (seen if largest is None else largest) / means[0]
        lowest = 1.0 if p_equal < alpha and value > 1 else 0.0
        highest = 1.0 if p_equal < alpha and value < 1 else np.inf
        low = min(low, max(low - reach, lowest))
        high = max(high, min(high + reach, highest))
    return Effect(*means, value, low, high, p_equal, evidence)


def mean_effect(first: Array, second: Array, alpha: float, largest: float) -> Effect:
    """Compares the means of two columns (trials,) of bounded numbers of either sign: second less
    first.

    The p is that of random signs, the interval the normal one, widened as that of a ratio by
    differences of at most `largest` in trials that may be unseen.
    """
    d = differences(second, first)
    trials = len(d)
    ones = np.ones(trials)
    quantile = -float(ndtri(alpha / 2))
    normal = quantile * float(d.std()) / np.sqrt(trials)
    reach = normal + _unseen(ones, d, alpha) * largest
    # A mean of 0 is a ratio of 0 to ones.
    p = _Signed.of(ones, d).p(0.0)
    size = abs(first[0]) + abs(second[0])
    evidence = no_lean(d, float(size) or 1.0)
    means = _means(first, second)
    mean = float(d.mean())
    return Effect(*means, mean, mean - reach, mean + reach, p, evidence)


@dataclass(frozen=True)
class _Signed:
    """Holds two columns, the trials that share a sign put together, and their sums under random
    signs (FLIPS,), which serve every ratio."""

    a: Array
    b: Array
    flipped_a: Array
    flipped_b: Array

    @classmethod
    def of(cls, first: Array, second: Array) -> _Signed:
        columns = np.array([first, second], dtype=float)
        a, b = grouped(columns, MOST_SIGNS).T.copy()
        signs = _signs(len(a))
        return cls(a, b, signs @ a, signs @ b)

    @property
    def swapped(self) -> _Signed:
        """The same with a in the place of b."""
        return _Signed(self.b, self.a, self.flipped_b, self.flipped_a)

    def p(self, ratio: float) -> float:
        """Computes the p of b being `ratio` times a: the share of sums with random signs at least
        as far from 0 as the sum of b - r a, itself included; if it is alone, Hoeffding's bound of
        this share (J. Amer. Statist. Assoc. 58, 1963)."""
        least = 1 / (FLIPS + 1)
        d = self.b - ratio * self.a
        total = abs(float(d.sum()))
        flipped = np.abs(self.flipped_b - ratio * self.flipped_a)
        size = float(np.abs(self.b).sum()) + ratio * float(self.a.sum())
        count = int((flipped >= total - 1e-12 * size).sum())
        if count:
            return (1 + count) * least
        # Hoeffding: |sum of +-d| is t or more in a share of at most 2 exp(-t^2 / (2 d'd)).
        exponent = -(total**2) / (2 * float(d @ d))
        return min(least, 2 * float(np.exp(exponent)))

    def least_ratio(self, alpha: float) -> float:
        """Finds the least ratio of b over a that is not rejected."""
        if self.p(0.0) >= alpha:
            return 0.0
        whole = float(self.b.sum() / self.a.sum())
        return first_that(lambda ratio: self.p(ratio) >= alpha, 0.0, whole)


def _unseen(first: Array, second: Array, alpha: float) -> float:
    """Computes the unseen share of trials that may have another ratio than the commonest one; 0 if
    enough have been seen."""
    with np.errstate(all="ignore"):
        # Round-off makes no ratio another one.
        ratios = (second / first).astype(np.float32)
    _, counts = np.unique(ratios, return_counts=True, equal_nan=True)
    trials = len(first)
    others = trials - int(counts.max())
    if others >= min(RARE, trials / 2):
        return 0.0
    return clopper_pearson(others, trials, 1 - alpha)[1] - others / trials


@lru_cache(maxsize=2)
def _signs(size: int) -> Array:
    """Draws signs (FLIPS, size) of 1 and -1, the same for all comparisons."""
    rng = generator(size)
    return rng.integers(0, 2, (FLIPS, size)) * 2.0 - 1


# Evidence ----------------------------------------------------------------------------------------


def fair_coin(heads: int, tails: int) -> float:
    """Measures evidence against a fair coin: the likelihood under a coin drawn from Beta(1/2, 1/2)
    over a fair one's.

    A martingale in the tosses, so it may be looked at after each of them (Robbins, Ann. Math.
    Statist. 41, 1970).
    """
    # B(h + 1/2, t + 1/2) / B(1/2, 1/2) over 2^-(h + t), by logarithms.
    drawn = betaln(heads + 0.5, tails + 0.5) - betaln(0.5, 0.5)
    return _exp(drawn + (heads + tails) * np.log(2))


def no_lean(differences: Array, unit: float) -> float:
    """Measures evidence against differences (trials,) that are as likely to have the other sign, of
    any size: the mean of exp(t d) / cosh(t d) over both signs of t, a martingale under such signs
    (de la Peña, Ann. Probab. 27, 1999). It exceeds 1 only on the side of their sum. `unit` is about
    what differences are of, and knows no signs."""
    tilts = _TILTS[:, None] * (differences / unit)[None, :]
    # log(exp(x) / cosh x) of each trial; their sum over trials is the evidence of one tilt.
    log_gains = tilts - np.logaddexp(tilts, -tilts) + np.log(2)
    together = float(np.logaddexp.reduce(log_gains.sum(axis=1)))
    return _exp(together - np.log(len(_TILTS)))


def _exp(value: float) -> float:
    """Computes exp without overflow: larger evidence is written as the largest number."""
    return float(np.exp(min(value, 690.0)))


# How many trials ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class PowerPlan:
    """Plans to find a difference of success, second less first, with this probability."""

    power: float
    difference: float

    @classmethod
    def of(
        cls, power: float | None, difference: float | None, *, anytime: bool = False
    ) -> PowerPlan | None:
        """Returns the plan that is asked for; None if none is.

        Raises:
            UserError: one of both is missing or no share, or the findings are those of e-values.
        """
        if power is None and difference is None:
            return None
        if power is None or difference is None:
            missing = "power" if power is None else "difference"
            raise UserError(
                f"{missing}: is not given; both go together, such as power=0.9 difference=0.05"
            )
        for name, value, example in (("power", power, 0.9), ("difference", difference, 0.05)):
            if not 0 < value < 1:
                raise UserError(f"{name}={value}: give a number between 0 and 1, such as {example}")
        if anytime:
            raise UserError(
                "power: needs a fixed number of trials; leave out anytime, or see precision= of run"
            )
        return cls(power, difference)

    def row(self, discordant: int, trials: int, alpha: float) -> dict[str, Any]:
        """Returns the columns `PLANNED`, from the number of trials, and of those in which one alone
        succeeds.

        Raises:
            UserError: there are too few trials to plan from, or the plan has more than `MOST`.
        """
        if trials < FEW:
            raise UserError(
                f"power: {trials} common trials are too few to plan from; run at least {FEW}"
            )
        # One end of an interval leaves out half of what both do.
        high = clopper_pearson(discordant, trials, 2 * LIMIT - 1)[1]
        share = max(high, self.difference)
        return {
            "power": self.power,
            "difference": self.difference,
            "discordant": discordant,
            "discordant_high": high,
            "trials_needed": trials_needed(share, self.difference, self.power, alpha),
        }


def mcnemar_power(trials: int, share: float, difference: float, alpha: float) -> float:
    """Computes the probability that McNemar's exact test at the level `alpha` finds a difference of
    success, where one estimator alone succeeds in a `share` of the trials.

    The number of these trials is binomial, and so is the number of those that the second wins
    (Duffy, Biometrics 40, 1984).
    """
    # The number m of discordant trials, within eight standard deviations of its mean.
    mean = trials * share
    reach = 8 * np.sqrt(mean * (1 - share)) + 8
    least = max(1, int(mean - reach))
    most = min(trials, int(mean + reach))
    m = np.arange(least, most + 1)
    probability = bdtr(m, trials, share) - bdtr(m - 1, trials, share)
    # The most that the loser may win for the test to reject: below 0 where it never does.
    level = np.array(alpha / 2)
    edge = least_count(m, np.array(0.5), level) - 1
    # Of m discordant trials the second wins a share (1 + difference / share) / 2.
    won = (1 + difference / share) / 2
    lost = np.maximum(edge, 0)
    rejects = bdtr(lost, m, won) + bdtr(lost, m, 1 - won)
    rejects = np.where(edge >= 0, rejects, 0.0)
    return float(np.sum(probability * rejects))


def trials_needed(share: float, difference: float, power: float, alpha: float) -> int:
    """Finds the least number of trials from which on the power is attained.

    Raises:
        UserError: it is above `MOST`.
    """

    def enough(trials: int) -> bool:
        return mcnemar_power(trials, share, difference, alpha) >= power

    # Doubling finds a number that is enough; bisection the least one beyond one that is not.
    low = 0
    high = 8
    while not enough(high):
        low = high
        high = 2 * high
        if high > MOST:
            raise UserError(
                f"difference={difference:g}: needs more than {MOST:,} trials; ask for a larger"
                " difference"
            )
    while high - low > 1:
        middle = (low + high) // 2
        if enough(middle):
            high = middle
        else:
            low = middle

    # The power falls again at some larger numbers: go beyond the last of them.
    checked = high
    while checked < high + _SAW:
        if not enough(checked):
            high = checked + 1
        checked += 1
    return high
