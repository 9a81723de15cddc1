"""What no estimator can beat: the linear bound, and standard deviations of the other bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import Array, Mask, definite_factor, deviations
from ipe_bench.estimators.ipe import frozen_covariance
from ipe_bench.estimators.least_squares import inverse_factor
from ipe_bench.measurements.problem import Problem


def linear_bound(problem: Problem) -> Array:
    """Standard deviations (n,) of eq. (5): what the linear LSE would reach if h were linear."""
    return deviations(frozen_covariance(problem.H_plus[None], problem.R))[0]


def linear_correlation(problem: Problem) -> Array:
    """Correlation (n, n) of the covariance of eq. (5)."""
    P, d = frozen_covariance(problem.H_plus[None], problem.R)[0], linear_bound(problem)
    return P / np.outer(d, d)


def bound_deviations(information: Array, rows: Callable[[Mask], Array]) -> Array:
    """Standard deviations (trials, n) of the bound whose inverse is `information` (trials, n, n); NaN where it is
    singular.

    `rows` gives A (some, k, n) with A' A = information of some trials: where that is ill-conditioned the bound is had
    from A by QR, since an inverse of A' A loses twice the digits, and with them the sign of a variance.
    """
    _, inverse_U, well = definite_factor(information)
    if not well.all():
        inverse_U = put(inverse_U, ~well, inverse_factor(rows(~well)))
    return np.sqrt(np.sum(inverse_U**2, axis=2))
