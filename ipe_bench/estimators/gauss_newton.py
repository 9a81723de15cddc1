"""The Gauss-Newton method."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.basics.linalg import Array, finite, multiply
from ipe_bench.estimators.driver import ConvergenceCheck, Solver
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Residuals, slope_at

_SMALL = 1e-10
"""Singular values of J below this share of the largest are taken for zero where J lacks rank."""


@dataclass(frozen=True)
class GaussNewtonMethod(Solver[LeastSquaresSystem]):
    """x <- x - (J' R^-1 J)^-1 J' R^-1 (h(x) - z), undamped; where J lacks rank, the shortest of all such steps."""

    def begin(self, objective: Residuals, x: Array) -> LeastSquaresSystem:
        return LeastSquaresSystem.at(objective, x)

    def step(self, objective: Residuals, state: LeastSquaresSystem) -> LeastSquaresSystem:
        step = _shortest(state) if state.rankless.any() else state.slope.newton
        x = state.x + step
        r = objective.residual(x)
        near = state.nearly(objective)
        slope, exact = slope_at(objective, x, r, near)
        moved = state.reach(step)
        regular = state.regular | np.isfinite(slope.size)
        cost = objective.cost(x, r)
        return replace(state, x=x, r=r, cost=cost, slope=slope, moved=moved, regular=regular, exact=exact, near=near)

    def check(
        self, objective: Residuals, before: LeastSquaresSystem | None, state: LeastSquaresSystem
    ) -> ConvergenceCheck:
        """Where J lacks rank and no step leads on, the trial ends as singular."""
        return state.check(objective, stuck=state.rankless & (state.moved == 0))


def _shortest(state: LeastSquaresSystem) -> Array:
    """The step (trials, n) of least length, in multiples of the parameters' sizes, that minimises |r + J s|."""
    slope, lost = state.slope, state.rankless & finite(state.slope.U) & finite(state.slope.gradient)
    step = slope.newton.copy()
    step[lost] = -multiply(np.linalg.pinv(slope.U[lost], rcond=_SMALL), slope.gradient[lost])
    return step
