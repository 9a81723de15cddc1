"""Re-linearised IPE: H is evaluated again at the estimate, until the root of eq. (11) is the least-squares minimum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ipe_bench.errors import UserError, require_counts, require_positive
from ipe_bench.estimation import Estimates, Estimator
from ipe_bench.ipe import Counted, FrozenSystem, Tally, find_roots, linear_deviation
from ipe_bench.linalg import Array, finite, information, inverse
from ipe_bench.scenario import Problem
from ipe_bench.solvers.base import Solver
from ipe_bench.solvers.fixed_point import FixedPoint
from ipe_bench.statuses import Status


@dataclass(frozen=True)
class Relinearized(Estimator):
    """Any solver on F(x) = H_k+ (h(x) - z), with H_k = dh/dx at the estimate x_k that the round before has reached.

    Where F(x_k) = 0 at its own linearisation, the gradient J' R^-1 (h - z) of least squares vanishes: the estimate is
    no longer a root of the frozen equation but the least-squares minimum, and its covariance is the Cramer-Rao bound.
    With one inner step of fixed-point iteration a round is a Gauss-Newton step; more of them save Jacobians.
    """

    solver: Solver = FixedPoint()  # noqa: RUF009 (frozen)
    start: Literal["linear_lse", "nominal"] = "linear_lse"
    inner_iterations: int = 5
    """Steps of the solver before H is evaluated again."""
    max_iterations: int = 30
    """Rounds, each with a new H."""
    tolerance: float = 1e-6
    """Largest abs(F_i(x_k)) at the linearisation there, in standard deviations of the local bound."""
    budget: float | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"

    def __post_init__(self) -> None:
        if self.start not in ("linear_lse", "nominal"):
            raise UserError(f"start={self.start}: choose linear_lse or nominal")
        require_positive(self, "tolerance", "budget")
        require_counts(self, "inner_iterations", "max_iterations")

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        frozen = FrozenSystem.at_nominal(problem, z)
        tally, n, trials = frozen.model.tally, problem.measurement.n, len(z)
        x = np.repeat(problem.x0[None], trials, axis=0)
        if self.start == "linear_lse":
            x = x - frozen.F(x)
        status = np.full(trials, Status.RUNNING, np.int8)
        iterations = np.zeros(trials, np.int64)
        iterates = [row[None] for row in x.copy()]
        budget = np.inf if self.budget is None else self.budget
        for _ in range(self.max_iterations):
            rows = np.flatnonzero(status == Status.RUNNING)
            if not len(rows):
                break
            system = frozen.subset(status == Status.RUNNING).relinearized(x[rows], problem.R)
            roots = find_roots(
                system,
                self.solver,
                x[rows],
                linear_deviation(system, problem),
                tolerance=self.tolerance,
                max_iterations=self.inner_iterations,
                budget=budget,
                history=history,
            )
            x[rows] = roots.x
            iterations[rows] += roots.iterations
            for row, part in zip(rows, roots.history or [], strict=False):
                iterates[row] = np.concatenate([iterates[row], part[1:]])
            # Converged is what holds at the linearisation itself, so before the first inner step; an inner root, an
            # inner stall or an inner limit is only the end of a round.
            at_once = (roots.status == Status.CONVERGED) & (roots.iterations == 0)
            on = np.isin(roots.status, [Status.CONVERGED, Status.STALLED, Status.MAX_ITERATIONS]) & ~at_once
            status[rows] = np.where(on, Status.RUNNING, roots.status)
        status[status == Status.RUNNING] = Status.MAX_ITERATIONS
        # For the report alone, so not counted; the model may raise where a trial has ended.
        J = np.full((trials, problem.measurement.m, n), np.nan)
        usable = finite(x)
        J[usable] = Counted(problem.measurement, Tally.zeros(trials)).jacobian(x[usable], np.flatnonzero(usable))
        return Estimates(
            x=x,
            status=status,
            covariance=inverse(information(J, problem.R))[0],
            iterations=iterations,
            simulations=tally.simulations.copy(),
            jacobians=tally.jacobians.copy(),
            messages=dict(tally.messages),
            history=iterates if history else None,
        )
