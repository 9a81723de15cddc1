"""Tests by Ljung and Box that successive numbers are uncorrelated (Biometrika 65, 1978)."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array

_LONGEST_LAG = 10


def white_p(e: Array) -> Array:
    """Computes the p-value (trials,) of the test that series e (trials, series, length) are
    white."""
    from scipy.special import chdtrc

    Q, lags = ljung_box(e)
    return chdtrc(lags, Q)


def ljung_box(e: Array) -> tuple[Array, Array]:
    """Computes Q (trials,) of series e (trials, series, length), pooled over the series of a trial,
    and the number (trials,) of lags at which there are two numbers: the degrees of freedom of Q, a
    chi-square if the series are white. A NaN is missing; Q is NaN if there is no such lag or all
    numbers are 0."""
    exists = np.isfinite(e)
    placed = np.where(exists, e, 0.0)
    count = exists.sum(axis=(1, 2))
    total = np.sum(placed**2, axis=(1, 2))
    Q = np.zeros(len(e))
    lags = np.zeros(len(e))
    longest = min(_LONGEST_LAG, max(1, e.shape[2] // 5))
    with np.errstate(invalid="ignore"):
        for k in range(1, longest + 1):
            both = exists[..., :-k] & exists[..., k:]
            number = np.sum(both, axis=(1, 2))
            products = placed[..., :-k] * placed[..., k:]
            # The autocorrelation at lag k.
            r = np.sum(products, axis=(1, 2)) / total
            # Its term of Q = N (N + 2) sum_k r_k^2 / (N - k), with N - k pairs at that lag.
            term = count * (count + 2) * r**2 / np.maximum(number, 1)
            Q += np.where(number > 0, term, 0.0)
            lags += number > 0
    return np.where(lags > 0, Q, np.nan), lags
