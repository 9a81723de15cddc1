"""Implements the methods of Gauss-Newton and of Levenberg and Marquardt, plain or with geodesic
acceleration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import Array, divisors, finite, multiply
from ipe_bench.estimators.driver import ConvergenceCheck, Method
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Objective, slope_at

_SMALL = 1e-10
"""Singular values of J below this share of the largest are taken for zero where J lacks rank."""
_LARGEST_DAMPING = 1e30
_ROUND_OFF = 1e-8
"""A predicted decrease below this share of the objective cannot be seen in the objective any
more."""
_PROBE = 0.1
"""The share of a step over which its curvature is measured."""
_MOST_BENT = 0.75
"""A correction for curvature is believed where twice its length is at most this share of the
step's."""


@dataclass(frozen=True)
class GaussNewtonMethod(Method[Objective, LeastSquaresSystem]):
    """Iterates x <- x - (J' R^-1 J)^-1 J' R^-1 (h(x) - z), undamped; where J lacks rank, by the
    shortest such step."""

    def begin(self, objective: Objective, x: Array) -> LeastSquaresSystem:
        return LeastSquaresSystem.at(objective, x)

    def step(self, objective: Objective, state: LeastSquaresSystem) -> LeastSquaresSystem:
        slope = state.slope
        step = slope.newton.copy()
        lost = state.rankless & finite(slope.U) & finite(slope.gradient)
        if lost.any():
            shortest = np.linalg.pinv(slope.U[lost], rcond=_SMALL)
            step[lost] = -multiply(shortest, slope.gradient[lost])
        x = state.x + step
        r = objective.residual(x)
        near = state.nearly(objective)
        slope, exact = slope_at(objective, x, r, near)
        return replace(
            state,
            x=x,
            r=r,
            cost=objective.cost(x, r),
            slope=slope,
            moved=state.reach(step),
            regular=state.regular | np.isfinite(slope.size),
            exact=exact,
            near=near,
        )

    def check(
        self, objective: Objective, before: LeastSquaresSystem | None, state: LeastSquaresSystem
    ) -> ConvergenceCheck:
        """Ends a trial as singular if J lacks rank and no step leads on."""
        return state.check(objective, stuck=state.rankless & (state.moved == 0))


@dataclass(frozen=True)
class LevenbergMarquardtMethod(Method[Objective, LeastSquaresSystem]):
    """Minimises |r + J s|^2 + lambda |D s|^2 in each step s, and adapts lambda to the gain ratio.

    D = 1 / `deviation` (n,), the metric of a prior covariance; None: Marquardt's, the column norms
    of J, which only grow (More, in Numerical Analysis, LNM 630, 1978); or, with `sizes`, the
    parameters' own magnitudes at the start, scaled as a whole to J there. lambda by Nielsen's rule
    (Madsen, Nielsen, Tingleff, Methods for Non-Linear Least Squares Problems, 2004, eq. 2.21).
    """

    damping: float
    """lambda at the start."""
    deviation: Array | None = None
    sizes: float | None = None
    """The magnitude of a parameter that begins nearer to zero than this; None: not this metric."""
    by_residual: bool = False
    """lambda begins at the mean squared residual where that is larger: far away, `damping` alone
    would be none."""
    geodesic: bool = False
    """Bends each step along the curvature of the readings, for one more simulation (Transtrum and
    Sethna, 2012, arXiv 1201.5885)."""

    def begin(self, objective: Objective, x: Array) -> LeastSquaresSystem:
        state = LeastSquaresSystem.at(objective, x, self.damping, keep_Q=self.geodesic)
        if self.deviation is not None:
            scale = np.broadcast_to(1.0 / self.deviation, state.scale.shape)
            state = replace(state, scale=scale)
        elif self.sizes is not None:
            magnitude = np.maximum(np.abs(x), self.sizes)
            whole = np.linalg.norm(state.slope.columns * magnitude, axis=1)
            whole = divisors(whole)
            state = replace(state, scale=whole[:, None] / magnitude)
        if not self.by_residual:
            return state
        mean_square = state.cost / state.r.shape[1]
        far = np.nan_to_num(mean_square, nan=1.0, posinf=1.0)
        return replace(state, lam=np.maximum(state.lam, far))

    def step(self, objective: Objective, state: LeastSquaresSystem) -> LeastSquaresSystem:
        weights = np.sqrt(state.lam)[:, None] * state.scale
        step, predicted = state.slope.damped(weights)
        bent, believed = self._bend(objective, state, weights, step)
        tried = state.x + bent
        r = objective.residual(tried)
        cost = objective.cost(tried, r)
        gain = (state.cost - cost) / predicted
        # Where no decrease can be seen any more, a step that promises one is taken.
        round_off = _ROUND_OFF * state.cost
        unseen = (predicted <= round_off) & (np.abs(cost - state.cost) <= 2 * round_off)
        taken = (gain > 0) | unseen
        factor = _damping_factor(np.where(unseen, 1.0, gain), believed)
        x = np.where(taken[:, None], tried, state.x)
        r = np.where(taken[:, None], r, state.r)
        cost = np.where(taken, cost, state.cost)
        near = state.nearly(objective)
        # Where steps of a coarse Jacobian go on failing, it may be the Jacobian.
        doubted = ~taken & ~state.exact & (near | (state.growth > 2.0))
        slope = state.slope
        exact = state.exact
        renewed = taken | doubted
        if renewed.any():
            part = objective.subset(renewed)
            wanted = (near | doubted)[renewed]
            there, known = slope_at(part, x[renewed], r[renewed], wanted, keep_Q=self.geodesic)
            slope = put(slope, renewed, there)
            exact = put(exact, renewed, known)
        refused = np.where(doubted, state.lam, state.lam * state.growth)
        mark, idle = state.watched(cost)
        return LeastSquaresSystem(
            x,
            r,
            cost,
            slope,
            moved=state.reach(step),
            lam=np.where(taken, state.lam * factor, refused),
            growth=np.where(taken, 2.0, 2.0 * state.growth),
            scale=self._scale(state.scale, slope.columns),
            regular=state.regular | np.isfinite(slope.size),
            mark=mark,
            idle=idle,
            exact=exact,
            near=near,
        )

    def check(
        self, objective: Objective, before: LeastSquaresSystem | None, state: LeastSquaresSystem
    ) -> ConvergenceCheck:
        """Continues damping where J lacks rank, until no gain is left."""
        return state.check(objective, stuck=state.lam > _LARGEST_DAMPING)

    def _scale(self, scale: Array, columns: Array) -> Array:
        """Computes the scale (trials, n) after a step: Marquardt's grows with the columns of J."""
        marquardt = self.deviation is None and self.sizes is None
        return np.fmax(scale, columns) if marquardt else scale

    def _bend(
        self, objective: Objective, state: LeastSquaresSystem, weights: Array, step: Array
    ) -> tuple[Array, Array]:
        """Returns the step v + a / 2 with the geodesic acceleration a, and whether a is small
        enough to be believed."""
        if not self.geodesic:
            return step, np.ones(len(step), dtype=bool)
        Q = state.slope.Q
        assert Q is not None
        # The second derivative of r along the step, in Q's columns, by a difference from the probe.
        probe = objective.residual(state.x + _PROBE * step)
        secant = multiply(Q.swapaxes(1, 2), probe - state.r) / _PROBE
        curvature = secant - multiply(state.slope.U, step)
        curvature = np.where(finite(curvature)[:, None], 2.0 / _PROBE * curvature, 0.0)
        a, _ = replace(state.slope, gradient=curvature).damped(weights)
        length = np.linalg.norm(step * state.scale, axis=1)
        correction = np.linalg.norm(a * state.scale, axis=1)
        believed = 2 * correction <= _MOST_BENT * length
        return step + np.where(believed[:, None], 0.5 * a, 0.0), believed


def _damping_factor(gain: Array, believed: Array) -> Array:
    """Computes Nielsen's factor (trials,) of lambda, max(1/3, 1 - (2 gain - 1)^3): below 1 where
    the decrease is more than half of what was predicted, and the step is `believed`."""
    excess = 2 * np.minimum(np.maximum(gain, 0), 1) - 1
    factor = np.maximum(1 / 3, 1 - excess**3)
    return np.where(believed, factor, np.maximum(factor, 1.0))
