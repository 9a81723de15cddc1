"""Batch least squares: Gauss-Newton, Levenberg-Marquardt, and Levenberg-Marquardt with the prior (MAP)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ipe_bench.errors import UserError, require_counts, require_positive
from ipe_bench.estimation import Estimates, Estimator
from ipe_bench.ipe import FrozenSystem
from ipe_bench.least_squares import Damping, Objective, minimize, report
from ipe_bench.linalg import Array
from ipe_bench.scenario import Problem


@dataclass(frozen=True)
class _Batch(Estimator):
    """The options that the batch methods share."""

    start: Literal["linear_lse", "nominal"] = "nominal"
    """Where the iteration begins: at the linear LSE, eq. (16), or at the nominal point."""
    max_iterations: int = 100
    """Steps tried."""
    tolerance: float = 1e-6
    """Largest Gauss-Newton step in standard deviations of the local bound: the gradient in whitened units."""
    budget: float | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    def __post_init__(self) -> None:
        if self.start not in ("linear_lse", "nominal"):
            raise UserError(f"start={self.start}: choose linear_lse or nominal")
        require_positive(self, "tolerance", "budget")
        require_counts(self, "max_iterations")

    def _minimize(self, objective: Objective, problem: Problem, damping: Damping | None, history: bool) -> Estimates:
        z, tally = objective.z, objective.model.tally
        x = np.repeat(problem.x0[None], len(z), axis=0)
        if self.start == "linear_lse":
            x = x - FrozenSystem.at_nominal(problem, z).F(x)
            tally.simulations += 1.0
        budget = np.inf if self.budget is None else self.budget
        minima = minimize(
            objective,
            x,
            damping=damping,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            budget=budget,
            history=history,
        )
        return report(minima, tally, z.shape[1])


@dataclass(frozen=True)
class GaussNewton(_Batch):
    """x <- x - (J' R^-1 J)^-1 J' R^-1 (h(x) - z), undamped unless `damping` is given: fast near the minimum, and lost
    where the model is not nearly linear between start and minimum."""

    start: Literal["linear_lse", "nominal"] = "linear_lse"
    damping: float | None = None
    """The initial lambda of Levenberg-Marquardt with Marquardt's scaling; None: no damping."""

    equation = "least_squares"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "damping")

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        damping = None if self.damping is None else Damping(self.damping)
        return self._minimize(Objective.of(problem, z, prior=False), problem, damping, history)


@dataclass(frozen=True)
class LevenbergMarquardt(_Batch):
    """Gauss-Newton whose step is kept short, with Marquardt's scaling, as long as the fit does not improve as predicted
    (Marquardt, J. SIAM 11, 1963; More, LNM 630, 1978)."""

    damping: float = 1e-3
    """lambda at the start."""

    equation = "least_squares"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "damping")

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        return self._minimize(Objective.of(problem, z, prior=False), problem, Damping(self.damping), history)


@dataclass(frozen=True)
class MapLM(_Batch):
    """The maximum a posteriori: least squares with the scenario's prior as further readings, by Levenberg-Marquardt
    damped in the metric of the prior. It is the batch answer that a filter with the same prior should equal.

    Reports (J' R^-1 J + P0^-1)^-1.
    """

    damping: float = 1.0
    """lambda at the start."""
    prior_inflation: float = 1.0
    """Times the prior's standard deviations."""

    needs = frozenset({"prior"})
    equation = "map"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "damping", "prior_inflation")

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z, prior=True, inflation=self.prior_inflation)
        return self._minimize(objective, problem, Damping(self.damping, objective.prior_deviation), history)
