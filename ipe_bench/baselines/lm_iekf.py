"""The iterated extended Kalman filter with Levenberg-Marquardt damping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipe_bench.baselines.information import Belief, EpochReadings, InformationFilter
from ipe_bench.basics.linalg import Array, multiply, squared
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.driver import Limits, SolveResult, iterate
from ipe_bench.estimators.least_squares import LeastSquaresSystem
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.counted import CountingModel


@dataclass(frozen=True)
class LMIEKF(InformationFilter):
    """An iterated EKF that finds each epoch's maximum a posteriori by Levenberg-Marquardt in place of Gauss-Newton
    (Särkkä and Svensson, ICASSP 2020), so that no step makes the fit of the epoch and its prior worse.

    Steps are damped in the metric of the prior that the earlier epochs left.
    """

    max_iterations: Count = 20
    """Steps tried per epoch; one that has not settled by then goes on from where it is."""
    tolerance: Positive = 1e-3
    """Largest Gauss-Newton step, in deviations of the updated P, at which an epoch is done."""
    damping: Positive = 1e-2
    """lambda at the start of every epoch."""

    name = "lm_iekf"

    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        problem = Standardized(readings, readings.belief.root())
        method = LevenbergMarquardtMethod(self.damping, np.ones(problem.n))
        start = method.begin(problem, np.zeros_like(readings.belief.mean))
        ended = iterate(problem, method, start, Limits(self.tolerance, self.max_iterations))
        return problem.belief(ended), start.cost - squared(start.slope.gradient)


@dataclass(frozen=True)
class Standardized:
    """An epoch's readings and its prior in terms of y = U (x - mean), which is N(0, I) before them."""

    readings: EpochReadings
    root: Array
    """U^-1 (trials, n, n)."""
    exact_within: float = np.inf

    @property
    def n(self) -> int:
        return self.root.shape[1]

    @property
    def model(self) -> CountingModel:
        return self.readings.model

    @property
    def rows(self) -> NDArray[np.intp]:
        return self.readings.rows

    def residual(self, y: Array) -> Array:
        """The whitened residuals, followed by y: the maximum a posteriori has the least squares of these."""
        return np.concatenate([self.readings.misfit(self._x(y)), y], axis=1)

    def cost(self, y: Array, r: Array) -> Array:
        return squared(r)

    def slopes(self, y: Array, *, coarse: bool) -> tuple[Array, None]:
        J = np.matmul(self.readings.slope(self._x(y)), self.root)
        return np.concatenate([J, np.broadcast_to(np.eye(self.n), self.root.shape)], axis=1), None

    def subset(self, kept: NDArray[np.bool_]) -> Standardized:
        return Standardized(self.readings.subset(kept), self.root[kept])

    def belief(self, ended: SolveResult[LeastSquaresSystem]) -> Belief:
        """What is believed where the search has ended, the readings linearised there; a lost trial has no mean."""
        slope = ended.state.slope
        # The step still to go is within the tolerance, and costs nothing.
        y = ended.x + np.where(ended.converged[:, None], slope.newton, 0.0)
        y = np.where((ended.status == Status.NONFINITE)[:, None], np.nan, y)
        return Belief(self._x(y), np.matmul(slope.U, self.readings.belief.U))

    def _x(self, y: Array) -> Array:
        return self.readings.belief.mean + multiply(self.root, y)
