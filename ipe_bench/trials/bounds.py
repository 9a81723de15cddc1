"""What no estimator can beat, as far as it needs no truth: the linear bound."""

from __future__ import annotations

from ipe_bench.basics.linalg import Array, deviations
from ipe_bench.estimators.ipe import frozen_covariance
from ipe_bench.measurements.problem import Problem


def linear_bound(problem: Problem) -> Array:
    """Standard deviations (n,) of eq. (5): what the linear LSE would reach if h were linear."""
    return deviations(frozen_covariance(problem.H_plus[None], problem.R))[0]
