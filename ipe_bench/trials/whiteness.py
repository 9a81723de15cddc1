"""Ljung and Box's test that successive numbers have nothing to do with each other (Biometrika 65, 1978)."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array

_LONGEST_LAG = 10


def lags_of(length: int) -> int:
    """The longest lag that is tested in series of that length."""
    return min(_LONGEST_LAG, max(1, length // 5))


def ljung_box(e: Array) -> Array:
    """Q (trials,) of series e (trials, series, length), pooled over the series of a trial: chi-square with `lags_of`
    degrees of freedom if they are white. A NaN is missing; Q is NaN if no number has a neighbour or all are 0."""
    exists = np.isfinite(e)
    placed = np.where(exists, e, 0.0)
    count, total = exists.sum(axis=(1, 2)), np.sum(placed**2, axis=(1, 2))
    Q, pairs = np.zeros(len(e)), np.zeros(len(e), dtype=int)
    with np.errstate(invalid="ignore"):
        for k in range(1, lags_of(e.shape[2]) + 1):
            number = np.sum(exists[:, :, :-k] & exists[:, :, k:], axis=(1, 2))
            r = np.sum(placed[:, :, :-k] * placed[:, :, k:], axis=(1, 2)) / total
            Q += np.where(number > 0, count * (count + 2) * r**2 / np.maximum(number, 1), 0.0)
            pairs += number
    return np.where(pairs > 0, Q, np.nan)
