"""The maximum a posteriori by the Levenberg-Marquardt method."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.baselines.batch import Batch
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.estimators.driver import Solver
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class MapLM(Batch):
    """The maximum a posteriori: least squares with the scenario's prior as further readings, by Levenberg-Marquardt
    damped in the metric of the prior. It is the batch answer that a filter with the same prior should equal.

    Reports (J' R^-1 J + P0^-1)^-1.
    """

    damping: Positive = 1.0
    """lambda at the start."""
    prior_inflation: Positive = 1.0
    """Times the prior's standard deviations."""

    needs = frozenset({"prior"})
    equation = "map"

    def objective(self, problem: Problem, z: Array) -> Objective:
        return Objective.of(problem, z, prior=True, inflation=self.prior_inflation)

    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        return LevenbergMarquardtMethod(self.damping, None if objective.prior is None else objective.prior.deviations)
