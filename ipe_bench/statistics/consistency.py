"""Whether an estimator's errors are as large as it says: limits of means and shares, and a verdict.

Numbers in, numbers out: what was estimated and how is left to others. Source: Bar-Shalom, Li, Kirubarajan, Estimation
with Applications to Tracking and Navigation, section 5.4; limits of shares are Clopper and Pearson's.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.special import chdtri
from scipy.stats import binomtest

from ipe_bench.basics.linalg import Array
from ipe_bench.trials.thresholds import GATE

TOLERATED = 0.01
"""Share of trials outside their own gate above which an estimator is named diverged but confident."""

Verdict = Literal["consistent", "pessimistic", "optimistic", "diverged but confident", "-"]


def mean_limits(degrees: float, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Where the mean over `trials` of chi-square / degrees lies with probability `level`, if all is consistent.

    NEES has n degrees per trial, NIS as many as the trial has readings (Bar-Shalom, Li and Kirubarajan, Estimation with
    Applications to Tracking and Navigation, 2001, sec. 5.4.2).
    """
    if trials < 1 or degrees < 1:
        return np.nan, np.nan
    tail = (1 - level) / 2
    low, high = chdtri(degrees * trials, np.array([1 - tail, tail])) / (degrees * trials)
    return float(low), float(high)


def clopper_pearson(count: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """The exact confidence interval of a share of which `count` in `trials` was seen.

    Clopper and Pearson, Biometrika 26, 1934.
    """
    if trials < 1:
        return np.nan, np.nan
    interval = binomtest(count, trials).proportion_ci(level, "exact")
    return float(interval.low), float(interval.high)


def verdict(nees: Array, n: int, level: float = 0.95) -> Verdict:
    """In one word, what an estimator's own covariance is worth: by the NEES (trials,) of the trials that it calls
    converged, as `scoring.nees` returns them, for n parameters.

    Diverged but confident: surely more than `TOLERATED` of the trials lie where the estimator says that a share of
    `GATE` should. A trial whose NEES is NaN made no claim and is left out.
    """
    claims = nees[~np.isnan(nees)]
    if not len(claims):
        return "-"
    outside = int(np.sum(claims > chdtri(n, GATE)))
    if clopper_pearson(outside, len(claims), level)[0] > TOLERATED:
        return "diverged but confident"
    low, high = mean_limits(n, len(claims), level)
    mean = claims.mean() / n
    if mean > high:
        return "optimistic"
    return "pessimistic" if mean < low else "consistent"
