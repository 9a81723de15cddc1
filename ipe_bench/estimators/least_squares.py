"""Least squares for a batch of trials: the objective, what a Jacobian says of it, and where a minimisation ended.

The methods have pages of their own, `gauss_newton` and `levenberg_marquardt`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import (
    Array,
    Covariance,
    Mask,
    definite_factor,
    finite,
    inverse,
    multiply,
    normal_equations,
    solve,
    squared,
)
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates
from ipe_bench.estimators.driver import ConvergenceCheck, Limits, Solver, SolveResult, iterate
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem

_VISIBLE = 1e-8
"""The smallest share by which the objective must have decreased to have decreased at all."""
_FLAT = 30
"""Steps without a visible decrease after which a nearly stationary point is as good as it gets."""
_STATIONARY = 1e-3
"""The part of a deviation, along every column of J, within which a point is nearly stationary."""

_NEAR = 0.03
"""Steps still to go of fewer deviations are computed from exact Jacobians: a coarse one leaves the gradient about a
hundredth of a deviation from zero."""


class Residuals(Protocol):
    """What the methods of this room minimise the squares of, for the trials of a batch."""

    def residual(self, x: Array, /) -> Array:
        """The residuals (trials, m) at x (trials, n), of unit variance."""
        ...

    def slopes(self, x: Array, /, *, coarse: bool) -> tuple[Array, Array | None]:
        """Their derivative (trials, m, n), or one near enough for steps; and what is left to divide its rows by (m,),
        None where nothing is."""
        ...

    def cost(self, x: Array, r: Array, /) -> Array:
        """What is minimised (trials,) at x, where the residuals are r: half its gradient is J' r."""
        ...

    @property
    def exact_within(self) -> float:
        """Where the Gauss-Newton step still to go is shorter than so many deviations, Jacobians are exact, elsewhere
        coarse; infinite: they are exact everywhere; 0: coarse, and good enough to end with."""
        ...

    def subset(self, kept: Mask, /) -> Residuals:
        """The same for some of the trials."""
        ...


@dataclass(frozen=True)
class Objective:
    """|R^-1/2 (h(x) - z)|^2, plus |P0^-1/2 (x - x0)|^2 where a prior counts, for the trials `rows`."""

    model: CountingModel
    R: Covariance
    z: Array
    rows: NDArray[np.intp]
    x0: Array
    """The centre of the prior: (n,), or each trial's own (trials, n)."""
    prior: Covariance | None = None
    """P0, where it counts."""
    exact_within: float = np.inf

    @classmethod
    def of(cls, problem: Problem, z: Array, *, prior: bool, inflation: float = 1.0) -> Objective:
        """The objective of all readings z (trials, m); with the prior, its deviations times `inflation`."""
        model = CountingModel(problem.measurement, EvaluationCount.zeros(len(z)))
        counting = problem.prior_covariance(inflation) if prior else None
        return cls(model, problem.R, z, np.arange(len(z)), problem.x0, counting)

    @property
    def readings(self) -> int:
        return self.z.shape[1]

    def residual(self, x: Array) -> Array:
        """Whitened residuals (trials, m), followed by those of the prior (trials, n) where it counts."""
        r = self.R.whiten(self.model.simulate(x, self.rows) - self.z)
        if self.prior is None:
            return r
        return np.concatenate([r, self.prior.whiten(x - self.x0)], axis=1)

    def cost(self, x: Array, r: Array) -> Array:
        return squared(r)

    def jacobian(self, x: Array) -> Array:
        """The derivative of the whitened residuals (trials, m, n) or (trials, m + n, n)."""
        J, deviation = self.slopes(x, coarse=False)
        return J if deviation is None else J / deviation[:, None]

    def slopes(self, x: Array, *, coarse: bool) -> tuple[Array, Array | None]:
        """The same, or from `Measurement.coarse_jacobian`, before its rows (m,) or (m + n,) are divided by those
        deviations, if there are any."""
        J, deviation = self.model.jacobian(x, self.rows, coarse=coarse), self.R.factor
        if deviation.ndim == 2:
            J, deviation = self.R.whiten_jacobian(J), np.ones(J.shape[1])
        if self.prior is None:
            return J, deviation
        n = x.shape[1]
        prior = np.broadcast_to(self.prior.whiten_jacobian(np.eye(n)), (len(x), n, n))
        return np.concatenate([J, prior], axis=1), np.concatenate([deviation, np.ones(n)])

    def coarsened(self, exact_within: float) -> Objective:
        """The same with coarse Jacobians where steps are longer, if the model has any that are cheaper."""
        cheaper = self.model.coarse_share < 1.0
        return dataclasses.replace(self, exact_within=exact_within if cheaper else np.inf)

    def subset(self, kept: Mask) -> Objective:
        if kept.dtype == bool and kept.all():
            return self
        x0 = self.x0[kept] if self.x0.ndim == 2 else self.x0
        return dataclasses.replace(self, z=self.z[kept], rows=self.rows[kept], x0=x0)


@dataclass(frozen=True)
class NormalEquations:
    """J = Q U of each trial: all that a step needs to know of the Jacobian."""

    U: Array
    inverse_U: Array
    """NaN where J has not full rank."""
    gradient: Array
    """Q' r (trials, n): the part of the residual that a step can remove."""
    columns: Array
    """Column norms of J (trials, n)."""
    newton: Array
    """The Gauss-Newton step (trials, n); NaN where J has not full rank."""
    size: Array
    """Its largest entry (trials,) in standard deviations of the local bound (J'J)^-1; infinite where J has not full
    rank."""
    stationary: Array
    """The largest part (trials,) of the residual along one column of J, in deviations: zero at a stationary point of
    whatever rank."""
    Q: Array | None = None
    """(trials, m, n), where a method asks for it."""

    @classmethod
    def of(cls, J: Array, r: Array, deviation: Array | None = None, *, keep_Q: bool = False) -> NormalEquations:
        """Of J (trials, m, n), its rows divided by `deviation` (m,), and residuals r (trials, m)."""
        G, along = normal_equations(J, r, deviation)
        U, inverse_U, well = definite_factor(G)
        well = well & finite(r)
        with np.errstate(all="ignore"):
            gradient = multiply(inverse_U.swapaxes(1, 2), along)
        if deviation is not None and keep_Q:
            J, deviation = J / deviation[:, None], None
        Q = np.matmul(np.ascontiguousarray(J), inverse_U) if keep_Q else None
        if not well.all():
            ill = J[~well] if deviation is None else J[~well] / deviation[:, None]
            QU, U[~well], inverse_U[~well], gradient[~well] = _by_orthogonal_factor(ill, r[~well])
            if Q is not None:
                Q[~well] = QU
        columns = np.sqrt(np.sum(U**2, axis=1))
        newton = -multiply(inverse_U, gradient)
        deviation = np.sqrt(np.sum(inverse_U**2, axis=2))
        size = np.abs(newton / deviation).max(axis=1)
        size = np.where(np.isfinite(size), size, np.inf)
        along = np.abs(multiply(U.swapaxes(1, 2), gradient)) / np.where(columns > 0, columns, 1.0)
        return cls(U, inverse_U, gradient, columns, newton, size, along.max(axis=1), Q)

    def towards(self, r: Array) -> NormalEquations:
        """The same Jacobian with another residual r (trials, m): a chord. It needs Q."""
        assert self.Q is not None
        gradient = multiply(self.Q.swapaxes(1, 2), r)
        newton = -multiply(self.inverse_U, gradient)
        size = np.abs(newton / np.sqrt(np.sum(self.inverse_U**2, axis=2))).max(axis=1)
        size = np.where(np.isfinite(size), size, np.inf)
        return dataclasses.replace(self, gradient=gradient, newton=newton, size=size)

    def damped(self, weights: Array) -> tuple[Array, Array]:
        """The step that minimises |r + J s|^2 + |weights s|^2, and the decrease of |r + J s|^2 + that it predicts."""
        with np.errstate(over="ignore"):  # an overflowing damping is treated by the other way
            squares = weights[:, :, None] ** 2 * np.eye(self.U.shape[1])
        _, root, well = definite_factor(np.matmul(self.U.swapaxes(1, 2), self.U) + squares)
        step = -multiply(root, multiply(root.swapaxes(1, 2), multiply(self.U.swapaxes(1, 2), self.gradient)))
        if not well.all():
            step[~well] = _damped_step(self.U[~well], weights[~well], self.gradient[~well])
        change = multiply(self.U, step)
        return step, -np.einsum("ti,ti->t", change, 2.0 * self.gradient + change)


def _damped_step(U: Array, weights: Array, gradient: Array) -> Array:
    """The step that minimises |gradient + U s|^2 + |weights s|^2 for any U."""
    n = U.shape[1]
    Q, V = np.linalg.qr(np.concatenate([U, weights[:, :, None] * np.eye(n)], axis=1))
    return solve(V, -multiply(Q[:, :n].swapaxes(1, 2), gradient))[0]


def _by_orthogonal_factor(J: Array, r: Array) -> tuple[Array, Array, Array, Array]:
    """Q, U, U^-1 and Q' r for any J; U^-1 is NaN where J has not full rank."""
    m, missing = J.shape[1], max(J.shape[2] - J.shape[1], 0)
    # Fewer readings than parameters: rows of zeros keep U square, and deficient.
    J, r = np.pad(J, ((0, 0), (0, missing), (0, 0))), np.pad(r, ((0, 0), (0, missing)))
    usable = finite(J) & finite(r)
    Q, U = np.linalg.qr(np.where(usable[:, None, None], J, 0.0))
    columns = np.sqrt(np.sum(U**2, axis=1))
    scaled = U / np.where(columns > 0, columns, 1.0)[:, None, :]
    floor = np.finfo(float).eps * max(J.shape[1:]) * np.sqrt(J.shape[2])
    deficient = ~usable | (np.abs(np.diagonal(scaled, axis1=1, axis2=2)).min(axis=1) <= floor)
    gradient = np.where(usable[:, None], multiply(Q.swapaxes(1, 2), r), np.nan)
    inverse_U, _ = inverse(np.where(deficient[:, None, None], np.nan, U))
    return Q[:, :m], U, inverse_U, gradient


def inverse_factor(J: Array) -> Array:
    """U^-1 (trials, n, n) of J = Q U (trials, m, n), so that (J'J)^-1 = U^-1 U^-T; NaN where J has not full rank."""
    return _by_orthogonal_factor(J, np.zeros(J.shape[:2]))[2]


def slope_at(
    objective: Residuals, x: Array, r: Array, exact: Mask, *, keep_Q: bool = False
) -> tuple[NormalEquations, Mask]:
    """The slope at x, where the residuals are r, and where it is that of an exact Jacobian: where `exact` (trials,)
    says so, and where a coarse one has not full rank."""
    if exact.all():
        return _slope_of(objective, x, r, coarse=False, keep_Q=keep_Q), exact
    if exact.any():
        coarse, believed = slope_at(objective.subset(~exact), x[~exact], r[~exact], exact[~exact], keep_Q=keep_Q)
        near = _slope_of(objective.subset(exact), x[exact], r[exact], coarse=False, keep_Q=keep_Q)
        both = take(near, np.zeros(len(x), np.intp))
        return put(put(both, exact, near), ~exact, coarse), put(exact, ~exact, believed)
    slope = _slope_of(objective, x, r, coarse=True, keep_Q=keep_Q)
    lost = ~np.isfinite(slope.size)
    if lost.any():
        again = _slope_of(objective.subset(lost), x[lost], r[lost], coarse=False, keep_Q=keep_Q)
        slope = put(slope, lost, again)
    return slope, lost


def _slope_of(objective: Residuals, x: Array, r: Array, *, coarse: bool, keep_Q: bool) -> NormalEquations:
    J, deviation = objective.slopes(x, coarse=coarse)
    return NormalEquations.of(J, r, deviation, keep_Q=keep_Q)


@dataclass(frozen=True)
class LeastSquaresSystem:
    """What these methods carry from step to step; every field has the trials in front."""

    x: Array
    r: Array
    """Whitened residuals, those of the prior included."""
    cost: Array
    """What is minimised: |r|^2, unless the objective says otherwise."""
    slope: NormalEquations
    moved: Array
    """The last step, tried or taken, in standard deviations of the readings that it moves."""
    lam: Array
    growth: Array
    scale: Array
    """What damping measures steps by: the diagonal of D (trials, n)."""
    regular: Mask
    """Where J had full rank somewhere on the way: an end without it is then a place, and no property of the problem."""
    mark: Array
    """The objective when it last decreased visibly."""
    idle: NDArray[np.int64]
    """Steps since the objective last decreased visibly."""
    exact: Mask
    """Where the slope is that of an exact Jacobian."""
    near: Mask
    """Where Jacobians are exact from now on, since the minimum is near."""

    @classmethod
    def at(cls, objective: Residuals, x: Array, lam: float = 0.0, *, keep_Q: bool = False) -> LeastSquaresSystem:
        """The state at the start."""
        r = objective.residual(x)
        trials = len(x)
        near = np.full(trials, np.isinf(objective.exact_within))
        slope, exact = slope_at(objective, x, r, near, keep_Q=keep_Q)
        scale = np.where(slope.columns > 0, slope.columns, 1.0)
        far, regular = np.full(trials, np.inf), np.isfinite(slope.size)
        cost, idle = objective.cost(x, r), np.zeros(trials, np.int64)
        damping, growth = np.full(trials, lam), np.full(trials, 2.0)
        return cls(x, r, cost, slope, far, damping, growth, scale, regular, cost, idle, exact, near)

    def nearly(self, objective: Residuals) -> Mask:
        """Where the next Jacobian is to be exact, and all after it."""
        return self.near | (self.slope.size < objective.exact_within)

    def reach(self, step: Array) -> Array:
        """The length (trials,) of a step in standard deviations of the readings that it moves."""
        return np.abs(step * self.slope.columns).max(axis=1)

    def watched(self, cost: Array) -> tuple[Array, NDArray[np.int64]]:
        """`mark` and `idle` after a step to an objective of that cost."""
        visible = cost < self.mark * (1 - _VISIBLE)
        return np.where(visible, cost, self.mark), np.where(visible, 0, self.idle + 1)

    @property
    def settled(self) -> Mask:
        """Where nothing can be gained: the answer is there, however badly the Jacobian or round-off behaves."""
        return (self.idle >= _FLAT) & (self.slope.stationary <= _STATIONARY) & self.regular

    @property
    def rankless(self) -> Mask:
        """Where J has not full rank (trials,)."""
        return ~np.isfinite(self.slope.size)

    def check(self, objective: Residuals, stuck: Mask) -> ConvergenceCheck:
        """The Gauss-Newton step still to go says how far the gradient is from zero, where J is good enough to end with;
        the cost says what diverges."""
        known = np.isfinite(self.cost) & finite(self.slope.gradient)
        level = np.where(known, np.sqrt(self.cost), np.nan)
        ending = np.where(self.rankless, Status.SINGULAR, Status.STALLED)
        size = np.where(self.rankless & self.regular, self.slope.stationary, self.slope.size)
        size = np.where(self.settled, 0.0, size)
        if objective.exact_within > 0:
            size = np.where(self.exact, size, np.inf)
        return ConvergenceCheck(size, level, self.moved, stuck, ending)


@dataclass(frozen=True)
class Minima:
    """Where the minimisation of each trial ended, with what is known of the objective there."""

    x: Array
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]
    history: list[Array] | None
    covariance: Array
    """(J' R^-1 J)^-1 (trials, n, n), with P0^-1 inside where the prior counts; NaN where it does not exist."""
    chi_square: Array
    """|R^-1/2 (h(x) - z)|^2 (trials,), of the readings alone."""
    bulk: Array
    """The median magnitude (trials,) of the readings' residuals in deviations: .67 where R is right, and little more
    where it is wrong for some of them only."""

    @classmethod
    def of(cls, ended: SolveResult[Any], covariance: Array, r: Array) -> Minima:
        """Where an iteration ended, with whitened residuals r (trials, m) there."""
        bulk = np.median(np.abs(r), axis=1)
        return cls(ended.x, ended.status, ended.iterations, ended.history, covariance, squared(r), bulk)

    @classmethod
    def nowhere(cls, x: Array, history: bool) -> Minima:
        """No minimum for any trial, at its start x (trials, n)."""
        trials, n = x.shape
        far = np.full(trials, np.inf)
        status, none = np.full(trials, Status.MAX_ITERATIONS, np.int8), np.zeros(trials, np.int64)
        return cls(
            x, status, none, [row[None] for row in x] if history else None, np.full((trials, n, n), np.nan), far, far
        )

    @property
    def converged(self) -> Mask:
        return self.status == Status.CONVERGED

    def better_than(self, old: Minima) -> Mask:
        """Which of these count rather than the old ones: they converged and are lower, or the old one had no end."""
        return self.converged & (~(self.chi_square >= old.chi_square) | ~old.converged)

    def replaced(self, rows: NDArray[np.intp], again: Minima, better: Mask) -> Minima:
        """The minima after further ones `again` of the trials `rows`, where these are `better`; iterations add up."""
        spent = self.iterations.copy()
        spent[rows] += again.iterations
        return dataclasses.replace(put(self, rows[better], take(again, better)), iterations=spent)

    def fit_probability(self, readings: int) -> Array:
        """The chi-square test of the fit (trials,): how probable residuals at least this large are if the model holds,
        R is right and the minimum is the global one."""
        from scipy.special import chdtrc

        return chdtrc(max(readings - self.x.shape[1], 1), self.chi_square)

    def estimates(self, tally: EvaluationCount, readings: int) -> Estimates:
        """What an estimator hands back."""
        extras = {"fit_p": self.fit_probability(readings)}
        return Estimates.of(self, tally, covariance=self.covariance, extras=extras)


def minimize(objective: Objective, method: Solver[LeastSquaresSystem], x: Array, limits: Limits) -> Minima:
    """Minimises the objective from x (trials, n) by Gauss-Newton or Levenberg-Marquardt.

    Converged is where the Gauss-Newton step, which is the gradient in whitened units, is at most `limits.tolerance`
    standard deviations of the local bound in every parameter. An iteration is a step tried, taken or not. Jacobians are
    coarse on the way, if the model has cheaper ones, and exact at the end.
    """
    if np.isinf(objective.exact_within):
        objective = objective.coarsened(_NEAR)
    ended = iterate(objective, method, x, limits)
    return minima_of(ended, _exact_slope(objective, ended.state), objective.readings)


def minima_of(ended: SolveResult[Any], slope: NormalEquations, readings: int) -> Minima:
    """What is known of the objective where an iteration of it ended with that slope."""
    # U^-1 U^-T: inverting U'U would lose twice the digits, and with them the sign of a variance.
    inverse_U, lost = slope.inverse_U, ~finite(slope.inverse_U)
    if lost.any():
        inverse_U = put(inverse_U, lost, inverse(slope.U[lost])[0])
    return Minima.of(ended, np.matmul(inverse_U, inverse_U.swapaxes(1, 2)), ended.state.r[:, :readings])


def _exact_slope(objective: Objective, state: LeastSquaresSystem) -> NormalEquations:
    """The slope where an iteration has ended; for the report alone where it ended on a coarse one, so not counted."""
    coarse = ~state.exact & finite(state.x)
    if objective.exact_within == 0 or not coarse.any():
        return state.slope
    tally = EvaluationCount.zeros(len(objective.model.tally.simulations))
    report = dataclasses.replace(objective, model=dataclasses.replace(objective.model, tally=tally)).subset(coarse)
    keep_Q = state.slope.Q is not None
    exact = _slope_of(report, state.x[coarse], state.r[coarse], coarse=False, keep_Q=keep_Q)
    return put(state.slope, coarse, exact)
