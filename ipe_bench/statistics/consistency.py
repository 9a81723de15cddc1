"""Whether errors are as large as an estimator says: limits of means and shares, and a verdict.

Sources: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4;
Clopper and Pearson, Biometrika 26, 1934.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.special import betaincinv, chdtri

from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.intervals import Squares, few_carry, rms_interval
from ipe_bench.trials.thresholds import FEW, gate

TOLERATED = 0.01
"""Share of trials outside their own gate above which an estimator is named diverged but confident."""
SEEN = 60
"""Trials from which an estimator is called pessimistic: with 95 % an error that one trial in twenty has is among so
many, and may be in none of fewer."""
_BETS = 0.99 * 2.0 ** -np.arange(9)
"""Shares of the stake."""

Verdict = Literal["consistent", "pessimistic", "optimistic", "undecided", "diverged but confident", "-"]


def mean_limits(degrees: float, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Where the mean over `trials` of chi-square / degrees lies with probability `level`, if all is consistent.

    NEES has n degrees per trial, NIS as many as the trial has readings (Bar-Shalom et al., sec. 5.4.2).
    """
    if trials < 1 or degrees < 1:
        return np.nan, np.nan
    tail = (1 - level) / 2
    low, high = chdtri(degrees * trials, np.array([1 - tail, tail])) / (degrees * trials)
    return float(low), float(high)


def clopper_pearson(count: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """The exact confidence interval of a share of which `count` in `trials` was seen."""
    if trials < 1:
        return np.nan, np.nan
    tail = (1 - level) / 2
    low = float(betaincinv(count, trials - count + 1, tail)) if count else 0.0
    return low, float(betaincinv(count + 1, trials - count, 1 - tail)) if count < trials else 1.0


def verdict(nees: Array, n: int, level: float = 0.95) -> Verdict:
    """In one word, what an estimator's own covariance is worth: by the NEES (trials,) of the trials that it calls
    converged, as `scoring.nees` returns them, for n parameters; none of fewer than `FEW`.

    Diverged but confident: surely more than `TOLERATED` of the trials lie where the estimator says that a share of
    `GATE` should, and the mean of NEES / n surely lies above 1, as it does not for a right covariance of errors with
    heavy tails. Optimistic, pessimistic: the mean of NEES / n surely lies above or below 1, by the interval that
    root mean squares have, whatever the law of the errors. Where few trials carry that mean there is no such interval:
    it may still surely lie above 1, and is undecided otherwise; so is one of fewer than `SEEN` trials that seems to lie
    below 1. A trial whose NEES is NaN made no claim and is left out.
    """
    claims = nees[~np.isnan(nees)]
    if len(claims) < FEW:
        return "-"
    x = np.minimum(claims / n, 1e150)
    above = _evidence_above_1(x) >= 2 / (1 - level)
    outside = int(np.sum(claims > gate(n)))
    if above and clopper_pearson(outside, len(claims), level)[0] > TOLERATED:
        return "diverged but confident"
    if few_carry(Squares.of(x[None]), np.array([n]))[0]:
        return "optimistic" if above else "undecided"
    low, high = rms_interval(x[:, None], level=level)
    if high[0] < 1:
        return "pessimistic" if len(claims) >= SEEN else "undecided"
    return "optimistic" if low[0] > 1 else "consistent"


def _evidence_above_1(x: Array) -> float:
    """Evidence that the mean of numbers (trials,) that are not negative is above 1, whatever their law: the mean
    fortune of those who bet fixed shares on it, which exceeds c with a probability of at most 1 / c otherwise."""
    fortunes = np.log1p(_BETS[:, None] * (x - 1)[None, :]).sum(axis=1)
    return float(np.mean(np.exp(np.minimum(fortunes, 600.0))))
