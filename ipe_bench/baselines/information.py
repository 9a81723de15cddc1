"""Filters that linearise an epoch's readings again and again: all trials at once, in square-root information form.

The covariance is kept as a square root U of P^-1 = U'U, which a QR decomposition updates (Bierman, Factorization
Methods for Discrete Sequential Estimation, 1977, ch. V): no S to invert and no P - K S K' to cancel, however wide the
prior is beside the noise.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ipe_bench.baselines.epochs import Epoch, Rows, Walk, read_members
from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite, inverse, multiply, squared
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.estimators.driver import Limits, SolveResult, iterate
from ipe_bench.estimators.least_squares import LeastSquaresSystem
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Belief:
    """N(mean, (U'U)^-1) for each trial, in prior deviations from the nominal point."""

    mean: Array
    """(trials, n)."""
    U: Array
    """(trials, n, n): any square root of the information."""

    @property
    def usable(self) -> Mask:
        """Where the numbers are finite (trials,)."""
        return finite(self.mean) & finite(self.U)

    def root(self) -> Array:
        """U^-1 (trials, n, n), so that P is it times its transpose; NaN where U is singular."""
        return inverse(self.U)[0]

    def given(self, J: Array, r: Array, at: Array) -> tuple[Belief, Array]:
        """What is believed after readings of unit variance, linear in x: h(at) - z is r (trials, m), dh/dx is J.

        Returns it with the squared innovations y' S^-1 y (trials,): chi-square with m degrees where the belief was
        right (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4).
        """
        # The step s = x - at that minimises |U (s + at - mean)|^2 + |J s + r|^2.
        rows = np.concatenate([self.U, J], axis=1)
        wanted = -np.concatenate([multiply(self.U, at - self.mean), r], axis=1)
        Q, U = np.linalg.qr(rows)
        fitted = multiply(Q.swapaxes(1, 2), wanted)
        step = multiply(inverse(U)[0], fitted)
        return Belief(at + step, U), squared(wanted) - squared(fitted)


@dataclass(frozen=True)
class EpochReadings:
    """The whitened readings z (trials, m) of an epoch, for the trials `rows`, and what was believed before them.

    x is in prior deviations from the nominal point.
    """

    epoch: Epoch
    problem: Problem
    deviation: Array
    """Of the scenario's prior (n,), in multiples of the parameters' units."""
    tally: EvaluationCount
    z: Array
    rows: Rows
    belief: Belief

    @property
    def model(self) -> CountingModel:
        return self.epoch.counted(self.tally)

    def misfit(self, x: Array) -> Array:
        """h(x) - z (trials, m), whitened."""
        return self.epoch.R.whiten(self.model.simulate(self.physical(x), self.rows)) - self.z

    def slope(self, x: Array) -> Array:
        """dh/dx (trials, m, n), whitened."""
        return self.epoch.R.whiten_jacobian(self.model.jacobian(self.physical(x), self.rows)) * self.deviation

    def misfits(self, points: Array) -> Array:
        """h - z (trials, points, m) at points (trials, points, n), whitened."""
        return read_members(self.model, self.epoch.R, self.physical(points), self.rows) - self.z[:, None]

    def subset(self, kept: Mask) -> EpochReadings:
        return replace(self, z=self.z[kept], rows=self.rows[kept], belief=take(self.belief, kept))

    def physical(self, x: Array) -> Array:
        """In multiples of the parameters' units."""
        return self.problem.x0 + x * self.deviation


@dataclass(frozen=True)
class InformationFilter(Estimator):
    """What the filters of this room have in common: the prior, the epochs, failures and the report.

    Reports its P, and as `extras["nis"]` the trial's squared innovations over their number: 1 on average where the
    filter is consistent.
    """

    prior_inflation: Positive = 1.0
    """The filter's prior deviations over the scenario's: in life a prior is never exact."""

    needs: ClassVar[frozenset[Need]] = frozenset({"epochs", "prior"})

    @abstractmethod
    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        """What is believed after an epoch's readings, and the squared innovations (trials,) of the prediction."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        self.require_needs(problem)
        with np.errstate(all="ignore"):
            return _Beliefs(self, problem, z).estimates(history=history)


class _Beliefs(Walk):
    """What is believed of the trials of a batch; those that fail keep what they believed before the epoch."""

    def __init__(self, filter: InformationFilter, problem: Problem, z: Array) -> None:
        super().__init__(problem, z)
        self.filter, self.d = filter, np.array(problem.prior_used())
        # U0' U0 = P0^-1, in deviations of the prior.
        U0 = np.linalg.cholesky(np.linalg.inv(problem.scaled_prior)).T / filter.prior_inflation
        self.belief = Belief(np.zeros((len(z), len(U0))), np.repeat(U0[None], len(z), axis=0))

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        z = epoch.whitened(self.z[at])
        readings = EpochReadings(epoch, self.problem, self.d, self.tally, z, at, take(self.belief, at))
        after, nis = self.filter.update(readings)
        raised, singular = self.tally.failed(at), ~finite(after.root()) & after.usable
        good = after.usable & np.isfinite(nis) & ~raised & ~singular
        self.belief = put(self.belief, at[good], take(after, good))
        self.nis[at[good]] += nis[good]
        lost = f"the model or the filter overflowed at epoch {epoch.number}"
        self.end(at[~good & ~raised & ~singular], Status.NONFINITE, lost)
        self.end(at[singular & ~raised], Status.SINGULAR, f"the information became singular at epoch {epoch.number}")
        self.status[at[raised]] = Status.ERROR
        S = self.belief.root()
        self.x, self.P = self.belief.mean, np.matmul(S, S.swapaxes(1, 2))

    def covariance(self, at: Rows) -> Array:
        S = take(self.belief, at).root() * self.d[:, None]
        return np.matmul(S, S.swapaxes(1, 2))


@dataclass(frozen=True)
class RecursiveUpdate(InformationFilter):
    """Zanetti's idea (IEEE TAC 57, 2012): an extended Kalman filter moves a part of the way and linearises again.

    A step takes in the readings as if their information were w_k R^-1, with weights w_k in geometric progression that
    add up to 1, so that each step multiplies what is known by about the same factor; the first is such that the largest
    eigenvalue of w_1 H P H' (H whitened) is about `first`. On a linear model all this is the Kalman filter.
    """

    steps: Count = 8
    """Linearisations per epoch."""
    first: Positive = 100.0
    """The information of the first step over that of the prior, in the direction that the readings see best."""

    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        belief = readings.belief
        r, J = readings.misfit(belief.mean), readings.slope(belief.mean)
        innovations = belief.given(J, r, belief.mean)[1]
        weights = geometric_weights(1.0 + _strength(J, belief) / self.first, self.steps)
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


def _strength(J: Array, belief: Belief) -> Array:
    """The largest eigenvalue of H P H' (trials,) for whitened slopes H."""
    moved = np.matmul(J, belief.root())
    moved = np.where(np.isfinite(moved).all(axis=(1, 2), keepdims=True), moved, 0.0)
    return np.linalg.norm(moved, ord=2, axis=(1, 2)) ** 2


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
        problem = _Standardized(readings, readings.belief.root())
        method = LevenbergMarquardtMethod(self.damping, np.ones(problem.n))
        start = method.begin(problem, np.zeros_like(readings.belief.mean))
        ended = iterate(problem, method, start, Limits(self.tolerance, self.max_iterations))
        return problem.belief(ended), start.cost - squared(start.slope.gradient)


@dataclass(frozen=True)
class _Standardized:
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
    def rows(self) -> Rows:
        return self.readings.rows

    def residual(self, y: Array) -> Array:
        """The whitened residuals, followed by y: the maximum a posteriori has the least squares of these."""
        return np.concatenate([self.readings.misfit(self._x(y)), y], axis=1)

    def cost(self, y: Array, r: Array) -> Array:
        return squared(r)

    def jacobian(self, y: Array, *, coarse: Mask | bool) -> Array:
        J = np.matmul(self.readings.slope(self._x(y)), self.root)
        return np.concatenate([J, np.broadcast_to(np.eye(self.n), self.root.shape)], axis=1)

    def subset(self, kept: Mask) -> _Standardized:
        return _Standardized(self.readings.subset(kept), self.root[kept])

    def belief(self, ended: SolveResult[LeastSquaresSystem]) -> Belief:
        """What is believed where the search has ended, the readings linearised there; a lost trial has no mean."""
        slope = ended.state.slope
        # The step still to go is within the tolerance, and costs nothing.
        y = ended.x + np.where(ended.converged[:, None], slope.newton, 0.0)
        y = np.where((ended.status == Status.NONFINITE)[:, None], np.nan, y)
        return Belief(self._x(y), np.matmul(slope.U, self.readings.belief.U))

    def _x(self, y: Array) -> Array:
        return self.readings.belief.mean + multiply(self.root, y)
