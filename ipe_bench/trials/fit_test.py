"""The test of fit: how probable residuals as large as these are if the model and R are right.

The sum of squares of whitened residuals is chi-square with m - n degrees only for least squares and
normal noise. Here its law follows from the noise, which states that of its whitened readings, and
from what the estimator makes of them:

- least squares leaves (I - P) w of whitened noise w, P the projection on the range of R^-1/2 J;
- the root of eq. (11) leaves (I - B) w with the oblique projection B = J (H+ J)^-1 H+;
- an estimate with a prior leaves residuals of covariance (I - J S J')(J P0 J' + I)(I - J S J'), S
  the covariance that it reports, over truths from the prior (whitened J).

It needs no truth, so it applies to real readings too.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import cast

import numpy as np

from ipe_bench.basics.definitions import definition_of
from ipe_bench.basics.linalg import Array, Covariance, finite, information
from ipe_bench.basics.streams import generator
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise

DRAWS = 10_000
"""Simulated fits behind the law where whitened noise is not normal: the smallest p is 1 / (DRAWS +
1)."""
_AT_ONCE = 2_000


@dataclass(frozen=True)
class Spread:
    """Holds the eigenvalues of the covariance of whitened residuals, trial by trial: those that are
    1, and `others`."""

    ones: int
    others: Array
    """(trials, k); empty for least squares."""

    @property
    def mean(self) -> Array:
        """The expected sum of squares (trials,): the effective degrees of freedom."""
        return self.ones + self.others.sum(axis=1)

    @property
    def squares(self) -> Array:
        """Half of the variance (trials,) of the sum of squares where the noise is normal."""
        return self.ones + (self.others**2).sum(axis=1)


def spread_of(estimator: Estimator, problem: Problem, J: Array) -> Spread:
    """Computes how the residuals scatter that an estimator leaves, with dh/dx = J (trials, m, n)
    near its estimates."""
    trials, m, n = J.shape
    prior = problem.prior_covariance()
    with np.errstate(all="ignore"):
        if "prior" in estimator.needs and prior is not None:
            inner = information(J, problem.R)
            return prior_spread(inner, m, prior.factor, inflation_of(estimator))
        if estimator.equation == "frozen" and np.isfinite(problem.H).all():
            return frozen_spread(J, problem.H, problem.R)
    return Spread(m - n, np.empty((trials, 0)))


def inflation_of(estimator: Estimator) -> float:
    """Returns the factor by which an estimator widens the prior: one that does solves an equation
    of its own."""
    if "prior" not in estimator.needs:
        return 1.0
    return float(getattr(estimator, "prior_inflation", 1.0))


def frozen_spread(J: Array, H: Array, R: Covariance) -> Spread:
    """Computes the spread for the root of eq. (11), with dh/dx = J (trials, m, n) and H (m, n): I -
    B is 1 outside the ranges of H and J, and 1 / cos of the principal angles between them on n
    directions."""
    m, n = H.shape
    # The cosines of the principal angles are the singular values of products of both bases.
    products = np.matmul(_basis(H[None], R).swapaxes(1, 2), _basis(J, R))
    usable = finite(products)[:, None, None]
    cosines = np.linalg.svd(np.where(usable, products, 0.0), compute_uv=False)
    with np.errstate(divide="ignore"):
        others = 1 / np.minimum(cosines, 1.0) ** 2
    # With fewer than n readings to spare the largest angles are those that are left.
    return Spread(max(m - 2 * n, 0), others[:, n - min(n, m - n) :])


def prior_spread(inner: Array, m: int, factor: Array, inflation: float = 1.0) -> Spread:
    """Computes the spread for an estimate from m readings with J' R^-1 J = inner (trials, n, n) and
    a prior of deviations `factor` (n,), or with that Cholesky factor (n, n), widened by `inflation`
    for the estimator."""
    n = len(factor)
    if factor.ndim == 1:
        values = inner * np.outer(factor, factor)
    else:
        values = np.matmul(np.matmul(factor.T, inner), factor)
    usable = finite(values)
    values = np.linalg.eigvalsh(np.where(usable[:, None, None], values, 0.0))
    values = np.where(usable[:, None], np.maximum(values, 0.0), np.nan)
    others = (1 + values) / (1 + inflation**2 * values) ** 2
    # Of m < n readings only the m largest have directions of their own.
    return Spread(max(m - n, 0), others[:, max(n - m, 0) :])


def _basis(J: Array, R: Covariance) -> Array:
    """Computes an orthonormal basis (trials, m, n) of the range of R^-1/2 J; NaN where J is not
    finite."""
    white = R.whiten_jacobian(J)
    usable = finite(white)[:, None, None]
    Q, _ = np.linalg.qr(np.where(usable, white, 0.0))
    return np.where(usable, Q, np.nan)


def fit_probability(squares: Array, spread: Spread, noise: Noise, H: Array, R: Covariance) -> Array:
    """Computes the chance (trials,) of a sum of squares of whitened residuals at least as large as
    `squares` (trials,).

    NaN where there are no residuals, or none to spare. Where spread is not that of least squares,
    the sum is scaled to the mean and variance of a sum that is (Satterthwaite, Biometrics Bulletin
    2, 1946).
    """
    from scipy.special import chdtrc

    m, n = H.shape
    if m <= n:
        return np.full(len(squares), np.nan)
    with np.errstate(all="ignore"):
        basis = _basis(H[None], R)[0].tobytes()
        reference = _reference(noise, definition_of(noise).digest, m, basis)
        if reference is None:
            ratio = spread.mean / spread.squares
            return chdtrc(spread.mean * ratio, squares * ratio)
        degrees = m - n
        alike = degrees + (squares - spread.mean) * np.sqrt(degrees / spread.squares)
    larger = len(reference) - np.searchsorted(reference, alike)
    p = (larger + 1) / (len(reference) + 1)
    # No draw is like a sum that is infinite.
    otherwise = np.where(alike == np.inf, 0.0, np.nan)
    return np.where(np.isfinite(alike), p, otherwise)


@functools.lru_cache(maxsize=16)
def _reference(noise: Noise, definition: str, m: int, basis: bytes) -> Array | None:
    """Simulates ascending sums of squares of least-squares residuals of whitened noise by this
    definition; None where it is normal."""
    Q = np.frombuffer(basis).reshape(m, -1)
    rng = generator(0)
    sums = []
    for _ in range(0, DRAWS, _AT_ONCE):
        w = noise.whitened((_AT_ONCE, m), rng)
        if w is None:
            return None
        # |(I - Q Q') w|^2 = |w|^2 - |Q' w|^2.
        explained = np.sum((w @ Q) ** 2, axis=1)
        sums.append(np.sum(w**2, axis=1) - explained)
    return cast(Array, np.sort(np.concatenate(sums)))
