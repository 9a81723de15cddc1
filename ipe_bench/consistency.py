"""Whether an estimator's errors are as large as it says: NEES, NIS and coverage, with their limits, and a verdict.

Numbers in, numbers out: what was estimated and how is left to others. Source: Bar-Shalom, Li, Kirubarajan, Estimation
with Applications to Tracking and Navigation, section 5.4; limits of shares are Clopper and Pearson's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import beta, chi2, norm

from ipe_bench.linalg import Array, solve

GATE = 1 - 1e-6
"""The quantile of chi-square beyond which a trial lies outside what its estimator reports."""
TOLERATED = 0.01
"""Share of trials outside their own gate above which an estimator is named diverged but confident."""

Verdict = Literal["consistent", "pessimistic", "optimistic", "diverged but confident", "unknown"]


def nees(error: Array, P: Array) -> Array:
    """The normalised estimation error squared e' P^-1 e / n of each trial (trials,): 1 on average where P is right.

    error (trials, n) and the reported covariance P (trials, n, n). Infinite where a finite P is singular and the error
    is not 0 or where the error is not finite; NaN where no P is reported.
    """
    n = error.shape[1]
    # Scaled by the deviations first: parameters' units must not decide what is singular.
    deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    with np.errstate(all="ignore"):
        e, C = error / deviation, P / (deviation[:, :, None] * deviation[:, None, :])
        x, unsolved = solve(C, np.where(np.isfinite(e), e, 0.0))
        value = np.einsum("ti,ti->t", e, x) / n
    reported = np.isfinite(P).all(axis=(1, 2))
    value = np.where(unsolved | ~np.isfinite(value) | (value < 0), np.inf, value)
    return np.where(reported, value, np.nan)


def mean_limits(degrees: float, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Where the mean over `trials` of chi-square / degrees lies with probability `level`, if all is consistent.

    NEES has n degrees per trial, NIS as many as the trial has readings.
    """
    if trials < 1:
        return np.nan, np.nan
    tail = (1 - level) / 2
    low, high = chi2.ppf([tail, 1 - tail], degrees * trials) / (degrees * trials)
    return float(low), float(high)


def share_limits(count: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Clopper-Pearson limits of a probability of which `count` in `trials` was seen."""
    if trials < 1:
        return np.nan, np.nan
    tail = (1 - level) / 2
    low = beta.ppf(tail, count, trials - count + 1) if count else 0.0
    high = beta.ppf(1 - tail, count + 1, trials - count) if count < trials else 1.0
    return float(low), float(high)


def coverage(error: Array, deviation: Array, level: float = 0.95) -> tuple[Array, Array]:
    """Whether each error (trials, n) lies within the interval of probability `level` that its reported deviation
    (trials, n) makes: the share (n,) of trials, and its limits (2, n). Not finite counts as outside."""
    with np.errstate(invalid="ignore"):
        inside = np.abs(error) <= norm.ppf((1 + level) / 2) * deviation
    counts = inside.sum(axis=0)
    limits = np.array([share_limits(int(count), len(error)) for count in counts]).reshape(-1, 2)
    return counts / max(1, len(error)), limits.T


@dataclass(frozen=True)
class Consistency:
    """What an estimator's own covariance is worth, over the trials in which it reported one."""

    trials: int
    """Trials with a finite estimate and covariance."""
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


def assess(error: Array, P: Array, *, nis: Array | None = None, readings: int = 0, level: float = 0.95) -> Consistency:
    """Compares errors (trials, n) with the covariances (trials, n, n) reported beside them.

    `nis` (trials,) is the NIS over the number of `readings`, of filters. Trials that reported no covariance, or ended
    without a finite estimate, made no claim and are left out; statuses tell of them.
    """
    n = error.shape[1]
    claimed = np.isfinite(error).all(axis=1) & np.isfinite(P).all(axis=(1, 2))
    values = nees(error[claimed], P[claimed])
    trials = len(values)
    beyond = int(np.sum(values > chi2.ppf(GATE, n) / n))
    limits = mean_limits(n, trials, level)
    shares = share_limits(beyond, trials, level)
    mean = float(values.mean()) if trials else np.nan
    nis_mean, nis_limits = np.nan, (np.nan, np.nan)
    if nis is not None and readings:
        known = nis[np.isfinite(nis)]
        nis_mean = float(known.mean()) if len(known) else np.nan
        nis_limits = mean_limits(readings, len(known), level)
    return Consistency(
        trials, mean, *limits, beyond / trials if trials else np.nan, *shares, nis_mean, nis_limits[0], nis_limits[1]
    )
