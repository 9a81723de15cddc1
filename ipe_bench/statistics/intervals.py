"""Intervals: how far a share, a root mean square error or a NEES may lie from its true value by chance."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ipe_bench.basics.linalg import Array

LEVEL = 0.95
RESAMPLES = 1000
LARGEST_SAMPLE = 2000
"""Above this many trials, groups of consecutive trials are resampled in their place."""


def bootstrap_rms(squares: Array, used: Array, level: float = LEVEL) -> tuple[Array, Array]:
    """Percentile bootstrap interval of the root mean square over the trials used, per column.

    squares is (trials, k), used (trials,) boolean. Trials are drawn with replacement (Efron and Tibshirani, An
    Introduction to the Bootstrap, 1993, ch. 13), used or not, so the number of used ones varies as it would; the draws
    are the same for every estimator. Of more than `LARGEST_SAMPLE` trials, groups of consecutive ones are drawn, which
    is as good since trials are independent.
    """
    trials, k = squares.shape
    if not used.any():
        return np.full(k, np.nan), np.full(k, np.nan)
    weighted = np.where(used[:, None], squares, 0.0)
    count = used.astype(float)
    if trials > LARGEST_SAMPLE:
        edges = np.linspace(0, trials, LARGEST_SAMPLE, endpoint=False).astype(int)
        weighted, count = np.add.reduceat(weighted, edges), np.add.reduceat(count, edges)
    draws = _draws(len(count))
    n = draws @ count
    with np.errstate(all="ignore"):
        rms = np.sqrt((draws @ weighted)[n > 0] / n[n > 0, None])
    tail = (1 - level) / 2
    low, high = np.quantile(rms, [tail, 1 - tail], axis=0)
    return low, high


@lru_cache(maxsize=4)
def _draws(size: int) -> Array:
    """How often each of `size` things is drawn in each resample: (RESAMPLES, size)."""
    rng = np.random.Generator(np.random.Philox(size))
    return rng.multinomial(size, np.full(size, 1 / size), size=RESAMPLES).astype(float)


def quantile(values: Array, q: float) -> float:
    """Quantile of non-negative numbers where non-finite ones count as infinite (linear between order statistics)."""
    return float(quantiles(values, np.array([q]))[0])


def quantiles(values: Array, q: Array) -> Array:
    """Several quantiles at once; see `quantile`."""
    if len(values) == 0:
        return np.full(len(q), np.nan)
    ordered = np.where(np.isfinite(values), values, np.inf)
    position = (len(values) - 1) * q
    low, high = np.floor(position).astype(int), np.ceil(position).astype(int)
    if len(q) > 4:
        ordered.sort()
    else:
        ordered.partition(np.unique(np.concatenate([low, high])))
    a, b, part = ordered[low], ordered[high], position - low
    # Between two infinite values, and at a value itself, nothing is interpolated: inf - inf is not a number.
    step = np.zeros(len(q))
    np.subtract(b, a, out=step, where=(a < b) & (part > 0))
    return a + step * np.where(part > 0, part, 0.0)
