"""The linear least-squares estimate, eqs. (2) and (5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.ipe import begin
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class LinearLSE(Estimator):
    """x = x0 + H+ (z - h(x0)): takes the measurement for linear. Reports (H' R^-1 H)^-1 as its covariance."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        x, system = begin(problem, z, "linear_lse")
        finite = np.isfinite(x).all(axis=1)
        tally = system.model.tally
        return Estimates(
            x=x,
            status=np.where(finite, Status.CONVERGED, Status.NONFINITE).astype(np.int8),
            covariance=np.repeat(system.covariance(), len(z), axis=0),
            simulations=tally.simulations,
            history=[np.stack([problem.x0, row]) for row in x] if history else None,
        )
