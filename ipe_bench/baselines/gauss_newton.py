"""The Gauss-Newton method as an estimator."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.baselines.batch import Batch
from ipe_bench.basics.options import Positive
from ipe_bench.estimators.driver import Solver
from ipe_bench.estimators.gauss_newton import GaussNewtonMethod
from ipe_bench.estimators.ipe import Start
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod


@dataclass(frozen=True)
class GaussNewton(Batch):
    """x <- x - (J' R^-1 J)^-1 J' R^-1 (h(x) - z), undamped unless `damping` is given: fast near the minimum, and lost
    where the model is not nearly linear between start and minimum."""

    start: Start = "linear_lse"
    damping: Positive | None = None
    """The initial lambda of Levenberg-Marquardt with Marquardt's scaling; None: no damping."""

    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        return GaussNewtonMethod() if self.damping is None else LevenbergMarquardtMethod(self.damping)
