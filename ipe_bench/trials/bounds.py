"""What no estimator can beat: the linear bound, and standard deviations of the other bounds."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import Array, Covariance, definite_factor, deviations, solve
from ipe_bench.estimators.ipe import frozen_covariance
from ipe_bench.estimators.least_squares import inverse_factor
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise


def linear_bound(problem: Problem) -> Array:
    """Standard deviations (n,) of eq. (5): what the linear LSE would reach if h were linear."""
    return deviations(frozen_covariance(problem.H_plus[None], problem.R))[0]


def linear_correlation(problem: Problem) -> Array:
    """Correlation (n, n) of the covariance of eq. (5)."""
    P, d = frozen_covariance(problem.H_plus[None], problem.R)[0], linear_bound(problem)
    return P / np.outer(d, d)


def informative_rows(noise: Noise, R: Covariance, J: Array, h: Array) -> Array:
    """Rows A (trials, k, n) with A' A the information on the parameters in readings h (trials, m) of slopes J (trials,
    m, n): R^-1/2 J; or, if levels of the noise are to be estimated with them, the rows of the normal law's information
    (Kay, Fundamentals of Statistical Signal Processing I, 1993, eq. 3.31), less what the levels explain."""
    known = noise.true_levels(h.shape[1])
    if known is None:
        return R.whiten_jacobian(J)
    levels, theta = known
    log, by_h, by_theta = levels.at(h, np.repeat(theta[None], len(h), axis=0))
    varying = by_h[:, :, None] * J
    transposed = by_theta.swapaxes(1, 2)
    explained, _ = solve(np.matmul(transposed, by_theta), np.matmul(transposed, varying))
    return np.concatenate(
        [J * np.exp(-log)[:, :, None], np.sqrt(2) * (varying - np.matmul(by_theta, explained))], axis=1
    )


def bound_deviations(information: Array, rows: Array) -> Array:
    """Standard deviations (trials, n) of the bound whose inverse is `information` A' A (trials, n, n), for rows A
    (trials, k, n); NaN where it is singular.

    An ill-conditioned bound is had from A by QR, since an inverse of A' A loses twice the digits, and with them the
    sign of a variance.
    """
    _, inverse_U, well = definite_factor(information)
    if not well.all():
        inverse_U = put(inverse_U, ~well, inverse_factor(rows[~well]))
    return np.sqrt(np.sum(inverse_U**2, axis=2))
