"""Filters that take in an epoch by small steps, or by damped ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.baselines.information import Belief, EpochReadings, InformationFilter
from ipe_bench.basics.linalg import Array, Mask, multiply, squared
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.driver import Limits, iterate
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod


@dataclass(frozen=True)
class RecursiveUpdate(InformationFilter):
    """Zanetti's idea (IEEE TAC 57, 2012): an extended Kalman filter moves a part of the way and
    linearises again.

    A step takes in the readings as if their information were w_k R^-1, with weights w_k in
    geometric progression that add up to 1, so that each step multiplies what is known by about the
    same factor; the first is such that the largest eigenvalue of w_1 H P H' (H whitened) is about
    `first`. On a linear model all this is the Kalman filter.
    """

    steps: Count = 8
    """Linearisations per epoch."""
    first: Positive = 100.0
    """The information of the first step over that of the prior, in the direction that the readings
    see best."""

    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        belief = readings.belief
        r, J = readings.misfit(belief.mean), readings.slope(belief.mean)
        innovations = belief.given(J, r, belief.mean)[1]
        # The largest eigenvalue of H P H' for whitened slopes H.
        moved = np.matmul(J, belief.root())
        moved = np.where(np.isfinite(moved).all(axis=(1, 2), keepdims=True), moved, 0.0)
        strength = np.linalg.norm(moved, ord=2, axis=(1, 2)) ** 2
        weights = geometric_weights(1.0 + strength / self.first, self.steps)
        for k in range(self.steps):
            if k:
                r, J = readings.misfit(belief.mean), readings.slope(belief.mean)
            root = np.sqrt(weights[:, k, None])
            belief, _ = belief.given(root[:, :, None] * J, root * r, belief.mean)
        return belief, innovations


def geometric_weights(ratio: Array, steps: int) -> Array:
    """Weights (trials, steps) that add up to 1, the last `ratio` (trials,) times the first."""
    weights = ratio[:, None] ** (np.arange(steps) / max(steps - 1, 1))
    return weights / weights.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class LMIEKF(InformationFilter):
    """An iterated EKF that finds each epoch's maximum a posteriori by Levenberg-Marquardt in place
    of Gauss-Newton (Särkkä and Svensson, ICASSP 2020), so that no step makes the fit of the epoch
    and its prior worse.

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
        problem, mean = (
            _Standardized.of_epoch(readings, readings.belief.root()),
            readings.belief.mean,
        )
        method = LevenbergMarquardtMethod(self.damping, np.ones(mean.shape[1]))
        start = method.begin(problem, np.zeros_like(mean))
        ended = iterate(problem, method, start, Limits(self.tolerance, self.max_iterations))
        slope = ended.state.slope
        # The step still to go is within the tolerance, and costs nothing.
        y = ended.x + np.where(ended.converged[:, None], slope.newton, 0.0)
        y = np.where((ended.status == Status.NONFINITE)[:, None], np.nan, y)
        found = Belief(mean + multiply(problem.root, y), np.matmul(slope.U, readings.belief.U))
        return found, start.cost - squared(start.slope.gradient)


@dataclass(frozen=True, kw_only=True)
class _Standardized(Objective):
    """An epoch's readings and its prior in terms of U (x - mean), which is N(0, I) before them."""

    given: EpochReadings
    root: Array
    """U^-1 (trials, n, n)."""

    @classmethod
    def of_epoch(cls, given: EpochReadings, root: Array) -> _Standardized:
        return cls(
            given.model,
            given.epoch.R,
            given.z,
            given.rows,
            given.belief.mean,
            given=given,
            root=root,
        )

    def residual(self, x: Array) -> Array:
        """The whitened residuals, followed by x: the maximum a posteriori has the least squares of
        these."""
        return np.concatenate([self.given.misfit(self.x0 + multiply(self.root, x)), x], axis=1)

    def jacobian(self, x: Array, *, coarse: Mask | bool = False) -> Array:
        J = np.matmul(self.given.slope(self.x0 + multiply(self.root, x)), self.root)
        return np.concatenate(
            [J, np.broadcast_to(np.eye(self.root.shape[1]), self.root.shape)], axis=1
        )

    def subset(self, kept: Mask) -> _Standardized:
        return _Standardized.of_epoch(self.given.subset(kept), self.root[kept])
