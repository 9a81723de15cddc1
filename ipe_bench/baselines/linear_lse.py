"""The linear least-squares estimate, eqs. (2) and (5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.estimation import Estimates, Estimator
from ipe_bench.ipe import FrozenSystem, frozen_covariance
from ipe_bench.linalg import Array
from ipe_bench.scenario import Problem
from ipe_bench.statuses import Status


@dataclass(frozen=True)
class LinearLSE(Estimator):
    """x = x0 + H+ (z - h(x0)): takes the measurement for linear. Reports (H' R^-1 H)^-1 as its covariance."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        system = FrozenSystem.at_nominal(problem, z)
        x0 = np.broadcast_to(problem.x0, (len(z), problem.measurement.n))
        x = x0 - system.F(x0)
        finite = np.isfinite(x).all(axis=1)
        tally = system.model.tally
        return Estimates(
            x=x,
            status=np.where(finite, Status.CONVERGED, Status.NONFINITE).astype(np.int8),
            covariance=np.repeat(frozen_covariance(system.H_plus, problem), len(z), axis=0),
            simulations=tally.simulations,
            history=[np.stack(pair) for pair in zip(x0, x, strict=True)] if history else None,
        )
