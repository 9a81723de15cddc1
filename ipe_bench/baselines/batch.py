"""What the batch least-squares baselines share: their start, their limits, and what they report."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Limits, Solver
from ipe_bench.estimators.ipe import Start, starting_points
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Objective, minimize
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Batch(Estimator):
    """Least squares on all readings at once; a subclass says what is minimised, and by which method."""

    start: Start = "nominal"
    """Where the iteration begins: at the linear LSE, eq. (16), at the nominal point, or at that of the two where the
    readings fit better (`best`)."""
    max_iterations: Count = 100
    """Steps tried."""
    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step in standard deviations of the local bound: the gradient in whitened units."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation: ClassVar = "least_squares"

    def objective(self, problem: Problem, z: Array) -> Objective:
        """What is minimised for readings z (trials, m)."""
        return Objective.of(problem, z, prior=False)

    @abstractmethod
    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        """What minimises it."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = self.objective(problem, z)
        tally = objective.model.tally
        x = starting_points(problem, z, self.start, tally)
        limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
        minima = minimize(objective, self.method(objective), x, limits)
        return minima.estimates(tally, z.shape[1])
