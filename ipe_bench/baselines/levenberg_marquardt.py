"""The Levenberg-Marquardt method as an estimator."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.baselines.batch import Batch
from ipe_bench.basics.options import Positive
from ipe_bench.estimators.driver import Solver
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod


@dataclass(frozen=True)
class LevenbergMarquardt(Batch):
    """Gauss-Newton whose step is kept short, with Marquardt's scaling, as long as the fit does not improve as predicted
    (Marquardt, J. SIAM 11, 1963; More, LNM 630, 1978)."""

    damping: Positive = 1e-3
    """lambda at the start."""
    geodesic: bool = False
    """Bends each step along the curvature of the readings, for one more simulation (Transtrum and Sethna, 2012,
    arXiv 1201.5885)."""

    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        return LevenbergMarquardtMethod(self.damping, geodesic=self.geodesic)
