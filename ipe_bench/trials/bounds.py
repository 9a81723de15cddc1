"""What no estimator can beat, as far as it needs no truth: the linear bound."""

from __future__ import annotations

from ipe_bench.basics.linalg import Array, deviations, pseudo_inverse
from ipe_bench.estimators.ipe import frozen_covariance
from ipe_bench.measurements.problem import Problem


def linear_bound(problem: Problem) -> Array:
    """Standard deviations (n,) of eq. (5): what the linear LSE would reach if h were linear."""
    H_plus, _ = pseudo_inverse(problem.H[None], problem.R)
    return deviations(frozen_covariance(H_plus, problem.R))[0]
