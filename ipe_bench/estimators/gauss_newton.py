"""The Gauss-Newton method."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ipe_bench.basics.linalg import Array
from ipe_bench.estimators.driver import Solver, Standing
from ipe_bench.estimators.least_squares import Descent, Residuals, slope_at, squared


@dataclass(frozen=True)
class GaussNewtonMethod(Solver[Descent]):
    """x <- x - (J' R^-1 J)^-1 J' R^-1 (h(x) - z), undamped."""

    def begin(self, objective: Residuals, x: Array) -> Descent:
        return Descent.at(objective, x)

    def step(self, objective: Residuals, state: Descent) -> Descent:
        x = state.x + state.slope.newton
        r = objective.residual(x)
        near = state.nearly(objective)
        slope, exact = slope_at(objective, x, r, near)
        moved = state.reach(state.slope.newton)
        return replace(state, x=x, r=r, cost=squared(r), slope=slope, moved=moved, exact=exact, near=near)

    def standing(self, objective: Residuals, before: Descent | None, state: Descent) -> Standing:
        """Where J lacks rank there is no step."""
        return state.standing(objective, stuck=state.rankless)
