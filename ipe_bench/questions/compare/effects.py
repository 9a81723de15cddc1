"""Compares two columns of numbers of the same trials: effects with intervals, evidence that allows repeated looks, and
the number of trials that a difference of success takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import bdtr, betaln, ndtri

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.calibration import least_count
from ipe_bench.statistics.comparisons import ALPHA, differences, mcnemar
from ipe_bench.statistics.intervals import RARE, clopper_pearson, first_that, grouped
from ipe_bench.trials.thresholds import FEW

FLIPS = 4999
"""Random assignments of signs."""
MOST_SIGNS = 1000
"""Largest number of signs; in more trials, consecutive ones share a sign: as good, since they are independent."""
_TILTS = np.concatenate([-(2.0 ** np.arange(-12, 5)), 2.0 ** np.arange(-12, 5)])
"""Multiples of the inverse unit by which differences are tilted, to either side."""
LIMIT = 0.8
"""Confidence of the upper limit of the discordant share: a plan by the share that a pilot shows is too small as often
as not."""
MOST = 10_000_000
"""Plans end at this many trials."""
_SAW = 20
"""Trials over which the power, which is a saw in their number, must stay."""
PLANNED = ("power", "difference", "discordant", "discordant_high", "trials_needed")
"""The columns that a plan adds to a row on success."""


@dataclass(frozen=True)
class Effect:
    """Holds the advantage of the second over the first, with interval, the p of no effect, and the evidence."""

    first_value: float
    second_value: float
    change: float
    """A ratio or a difference, as the function that made it says."""
    low: float = np.nan
    high: float = np.nan
    p: float = np.nan
    e: float = np.nan
    """An e-value: by chance it exceeds 1/alpha, at whatever number of trials one looks, in a share alpha of cases."""


# Effects -------------------------------------------------------------------------------------------------------------


def success_effect(first: Array, second: Array, alpha: float = ALPHA) -> Effect:
    """Computes the difference of two shares of the same trials (trials,), second less first.

    The p is McNemar's exact one: given their number, the trials in which one alone succeeds are fair coin tosses. The
    interval is Tango's (Stat. Med. 17, 1998), of the score; it is widened to hold 0 where the exact test does not
    reject.
    """
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    trials, p = len(first), mcnemar(only_first, only_second)
    low, high = (
        _tango(only_first, only_second, trials, alpha),
        -_tango(only_second, only_first, trials, alpha),
    )
    if p >= alpha:
        low, high = min(low, 0.0), max(high, 0.0)
    change, e = (only_second - only_first) / trials, fair_coin(only_first, only_second)
    return Effect(float(first.mean()), float(second.mean()), change, low, high, p, e)


def _tango(losses: int, gains: int, trials: int, alpha: float) -> float:
    """Finds the least difference of shares at which the score, with the likeliest shares of that difference, is not
    beyond the normal quantile."""
    quantile = -float(ndtri(alpha / 2))

    def inside(difference: float) -> bool:
        b = losses + gains + difference * (gains - losses - 2 * trials)
        root = max(b * b + 8 * trials * losses * difference * (1 - difference), 0.0)
        lost = (b + np.sqrt(root)) / (4 * trials)
        variance = trials * max(2 * lost + difference * (1 - difference), 0.0)
        return bool(gains - losses - trials * difference <= quantile * np.sqrt(variance))

    return first_that(inside, -1.0, (gains - losses) / trials)


def ratio_effect(
    first: Array, second: Array, alpha: float = ALPHA, largest: float | None = None
) -> Effect:
    """Computes the ratio of the means of two columns (trials,) of finite nonnegative numbers, second over first.

    Where neither is larger by nature, each trial's difference is as likely to have the other sign: the p is the share
    of random signs whose sum is as far from 0 (Fisher, The Design of Experiments, 1935, sec. 21), the interval holds
    the ratios r that the same test does not reject for second less r times first. An end that no ratio reaches is 0 or
    infinite.

    Where nearly all trials have one ratio, signs say nothing of the others, which are rare and perhaps unseen: the
    interval is widened by the share of trials that may differ beyond those that did (the upper limit of Clopper and
    Pearson), each by `largest`, the largest difference there can be; None: the largest number seen. It is never widened
    over a ratio of 1 that the test rejects.
    """
    a, b = grouped(np.array([first, second], dtype=float), MOST_SIGNS).T.copy()
    means, p_equal = (float(first.mean()), float(second.mean())), _p_of_ratio(a, b)(1.0)
    # The first trial is the unit: whoever looks later divides by the same.
    evidence = no_lean(second - first, float(first[0] + second[0]) or 1.0)
    total_a, total_b = float(a.sum()), float(b.sum())
    if not total_a > 0 or not total_b > 0:
        return Effect(*means, total_b / total_a if total_a > 0 else np.nan, p=p_equal, e=evidence)
    value = total_b / total_a
    low, least = _least_ratio(a, b, alpha), _least_ratio(b, a, alpha)
    high = 1 / least if least > 0 else np.inf
    if unseen := _unseen(first, second, alpha):
        reach = unseen * (max(first.max(), second.max()) if largest is None else largest) / means[0]
        sure = p_equal < alpha
        low = min(low, max(low - reach, 1.0 if sure and value > 1 else 0.0))
        high = max(high, min(high + reach, 1.0 if sure and value < 1 else np.inf))
    return Effect(*means, value, low, high, p_equal, evidence)


def mean_effect(first: Array, second: Array, alpha: float, largest: float) -> Effect:
    """Compares the means of two columns (trials,) of bounded numbers of either sign: second less first.

    The p is that of random signs, the interval the normal one, widened as that of a ratio by differences of at most
    `largest` in trials that may be unseen.
    """
    d = differences(second, first)
    ones, mean = np.ones(len(d)), float(d.mean())
    reach = (
        -float(ndtri(alpha / 2)) * float(d.std()) / np.sqrt(len(d))
        + _unseen(ones, d, alpha) * largest
    )
    p = _p_of_ratio(*grouped(np.array([ones, d]), MOST_SIGNS).T.copy())(0.0)
    evidence = no_lean(d, float(abs(first[0]) + abs(second[0])) or 1.0)
    return Effect(
        float(first.mean()), float(second.mean()), mean, mean - reach, mean + reach, p, evidence
    )


def _p_of_ratio(a: Array, b: Array) -> Callable[[float], float]:
    """Computes the p of b being r times a: the share of sums with random signs at least as far from 0 as the sum of b -
    r a, itself included; if it is alone, Hoeffding's bound of this share (J. Amer. Statist. Assoc. 58, 1963)."""
    signs = _signs(len(a))
    flipped_a, flipped_b, size_a, size_b = (
        signs @ a,
        signs @ b,
        float(a.sum()),
        float(np.abs(b).sum()),
    )

    def p(ratio: float) -> float:
        d, flipped, roundoff = (
            b - ratio * a,
            flipped_b - ratio * flipped_a,
            1e-12 * (size_b + ratio * size_a),
        )
        total = abs(float(d.sum()))
        count = int((np.abs(flipped) >= total - roundoff).sum())
        least = 1 / (FLIPS + 1)
        return (
            (1 + count) * least
            if count
            else min(least, 2 * float(np.exp(-(total**2) / (2 * float(d @ d)))))
        )

    return p


def _least_ratio(a: Array, b: Array, alpha: float) -> float:
    """Finds the least ratio of b over a that is not rejected."""
    p = _p_of_ratio(a, b)
    return (
        0.0
        if p(0.0) >= alpha
        else first_that(lambda ratio: p(ratio) >= alpha, 0.0, float(b.sum() / a.sum()))
    )


def _unseen(first: Array, second: Array, alpha: float) -> float:
    """Computes the unseen share of trials that may have another ratio than the commonest one; 0 if enough have been
    seen."""
    with np.errstate(all="ignore"):
        # Round-off makes no ratio another one.
        _, counts = np.unique(
            (second / first).astype(np.float32), return_counts=True, equal_nan=True
        )
    others, trials = len(first) - int(counts.max()), len(first)
    if others >= min(RARE, trials / 2):
        return 0.0
    return clopper_pearson(others, trials, 1 - alpha)[1] - others / trials


@lru_cache(maxsize=2)
def _signs(size: int) -> Array:
    """Draws signs (FLIPS, size) of 1 and -1, the same for all comparisons."""
    rng = np.random.Generator(np.random.Philox(size))
    return rng.integers(0, 2, (FLIPS, size)) * 2.0 - 1


# Evidence ------------------------------------------------------------------------------------------------------------


def fair_coin(heads: int, tails: int) -> float:
    """Measures evidence against a fair coin: the likelihood under a coin drawn from Beta(1/2, 1/2) over a fair one's.

    A martingale in the tosses, so it may be looked at after each of them (Robbins, Ann. Math. Statist. 41, 1970).
    """
    return _exp(betaln(heads + 0.5, tails + 0.5) - betaln(0.5, 0.5) + (heads + tails) * np.log(2))


def no_lean(differences: Array, unit: float) -> float:
    """Measures evidence against differences (trials,) that are as likely to have the other sign, of any size: the mean
    of exp(t d) / cosh(t d) over both signs of t, a martingale under such signs (de la Peña, Ann. Probab. 27, 1999). It
    exceeds 1 only on the side of their sum. `unit` is about what differences are of, and knows no signs."""
    tilts = _TILTS[:, None] * (differences / unit)[None, :]
    log_gains = tilts - np.logaddexp(tilts, -tilts) + np.log(2)
    return _exp(float(np.logaddexp.reduce(log_gains.sum(axis=1))) - np.log(len(_TILTS)))


def _exp(value: float) -> float:
    """Computes exp without overflow: larger evidence is written as the largest number."""
    return float(np.exp(min(value, 690.0)))


# How many trials -----------------------------------------------------------------------------------------------------


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
        """Returns the columns `PLANNED`, from the number of trials, and of those in which one alone succeeds.

        Raises:
            UserError: there are too few trials to plan from, or the plan has more than `MOST`.
        """
        if trials < FEW:
            raise UserError(
                f"power: {trials} common trials are too few to plan from; run at least {FEW}"
            )
        # One end of an interval leaves out half of what both do.
        high = clopper_pearson(discordant, trials, 2 * LIMIT - 1)[1]
        needed = trials_needed(max(high, self.difference), self.difference, self.power, alpha)
        return dict(
            zip(PLANNED, (self.power, self.difference, discordant, high, needed), strict=True)
        )


def mcnemar_power(trials: int, share: float, difference: float, alpha: float) -> float:
    """Computes the probability that McNemar's exact test at the level `alpha` finds a difference of success, where one
    estimator alone succeeds in a `share` of the trials.

    The number of these trials is binomial, and so is the number of those that the second wins (Duffy, Biometrics 40,
    1984).
    """
    mean, reach = trials * share, 8 * np.sqrt(trials * share * (1 - share)) + 8
    m = np.arange(max(1, int(mean - reach)), min(trials, int(mean + reach)) + 1)
    probability = bdtr(m, trials, share) - bdtr(m - 1, trials, share)
    # The most that the loser may win for the test to reject.
    edge = least_count(m, np.array(0.5), np.array(alpha / 2)) - 1
    won = (1 + difference / share) / 2
    rejects = bdtr(np.maximum(edge, 0), m, won) + bdtr(np.maximum(edge, 0), m, 1 - won)
    return float(np.sum(probability * np.where(edge >= 0, rejects, 0.0)))


def trials_needed(share: float, difference: float, power: float, alpha: float) -> int:
    """Finds the least number of trials from which on the power is attained.

    Raises:
        UserError: it is above `MOST`.
    """

    def enough(trials: int) -> bool:
        return mcnemar_power(trials, share, difference, alpha) >= power

    low, high = 0, 8
    while not enough(high):
        low, high = high, 2 * high
        if high > MOST:
            raise UserError(
                f"difference={difference:g}: needs more than {MOST:,} trials; ask for a larger difference"
            )
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    while below := [n for n in range(high, high + _SAW) if not enough(n)]:
        high = below[-1] + 1
    return high
