"""Whether an estimator's errors are as large as it says: NEES, NIS and coverage, with their limits, and a verdict.

Numbers in, numbers out: what was estimated and how is left to others. Source: Bar-Shalom, Li, Kirubarajan, Estimation
with Applications to Tracking and Navigation, section 5.4; limits of shares are Clopper and Pearson's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import betaincinv, chdtri, ndtri

from ipe_bench.basics.linalg import Array

GATE = 1e-6
"""A trial lies outside what its estimator reports where chance would put this share of trials."""
TOLERATED = 0.01
"""Share of trials outside their own gate above which an estimator is named diverged but confident."""

Verdict = Literal["consistent", "pessimistic", "optimistic", "diverged but confident", "unknown"]


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
    tail = (1 - level) / 2
    low = betaincinv(count, trials - count + 1, tail) if count else 0.0
    high = betaincinv(count + 1, trials - count, 1 - tail) if count < trials else 1.0
    return float(low), float(high)


def coverage(error: Array, deviation: Array, level: float = 0.95) -> tuple[Array, Array]:
    """Whether each error (trials, n) lies within the interval of probability `level` that its reported deviation
    (trials, n) makes: the share (n,) of trials, and its limits (2, n). Not finite counts as outside."""
    with np.errstate(invalid="ignore"):
        inside = np.abs(error) <= ndtri((1 + level) / 2) * deviation
    counts = inside.sum(axis=0)
    limits = np.array([clopper_pearson(int(count), len(error)) for count in counts]).reshape(-1, 2)
    return counts / max(1, len(error)), limits.T


@dataclass(frozen=True)
class Consistency:
    """What an estimator's own covariance is worth, over the trials in which it reported one."""

    trials: int
    """Trials in which it reported one."""
    nees: float
    """Mean NEES over n."""
    nees_low: float
    nees_high: float
    """Limits of the mean where the estimator is consistent."""
    outside: float
    """Share of trials whose error lies outside their own gate (`GATE`)."""
    outside_low: float
    outside_high: float
    nis: float = np.nan
    """Mean NIS over the number of readings: like NEES, but it needs no truth."""
    nis_low: float = np.nan
    nis_high: float = np.nan

    @property
    def verdict(self) -> Verdict:
        """In one word. Diverged but confident: surely more than `TOLERATED` of the trials lie where the estimator says
        that one in a million should."""
        if not self.trials:
            return "unknown"
        if self.outside_low > TOLERATED:
            return "diverged but confident"
        if self.nees > self.nees_high:
            return "optimistic"
        return "pessimistic" if self.nees < self.nees_low else "consistent"


def assess(nees: Array, n: int, *, nis: Array | None = None, readings: int = 0, level: float = 0.95) -> Consistency:
    """Judges an estimator of n parameters by the NEES (trials,) of its trials, as `nees` returns them.

    `nis` (trials,) is the NIS over the number of `readings`, as filters report it. A trial whose NEES is NaN made no
    claim and is left out; its status tells of it.
    """
    claims = nees[~np.isnan(nees)]
    trials = len(claims)
    beyond = int(np.sum(claims > chdtri(n, GATE)))
    nis = np.empty(0) if nis is None else nis[np.isfinite(nis)]
    return Consistency(
        trials,
        float(claims.mean() / n) if trials else np.nan,
        *mean_limits(n, trials, level),
        beyond / trials if trials else np.nan,
        *clopper_pearson(beyond, trials, level),
        float(nis.mean()) if len(nis) else np.nan,
        *mean_limits(readings, len(nis), level),
    )
