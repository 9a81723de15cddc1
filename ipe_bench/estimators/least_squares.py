"""Defines least squares for a batch of trials: the objective, its normal equations, and the state
of an iteration."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import (
    Array,
    Covariance,
    Mask,
    definite_factor,
    diagonal,
    divisors,
    finite,
    finite_or,
    gram,
    inverse,
    multiply,
    solve,
    squared,
)
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.driver import ConvergenceCheck
from ipe_bench.measurements.counted import CountingModel, EvaluationCount

if TYPE_CHECKING:
    from ipe_bench.measurements.problem import Problem

_VISIBLE = 1e-8
"""The smallest share by which the objective must have decreased to have decreased at all."""
_FLAT = 30
"""Steps without a visible decrease after which a nearly stationary point is as good as it gets."""
_STATIONARY = 1e-3
"""The part of a deviation, along every column of J, within which a point is nearly stationary."""


@dataclass(frozen=True)
class Objective:
    """Computes |R^-1/2 (h(x) - z)|^2, plus |P0^-1/2 (x - x0)|^2 where a prior counts, for the
    trials `rows`."""

    model: CountingModel
    R: Covariance
    z: Array
    rows: NDArray[np.intp]
    x0: Array
    """The centre of the prior: (n,), or each trial's own (trials, n)."""
    prior: Covariance | None = None
    """P0, where it counts."""
    exact_within: float = np.inf
    """Jacobians are exact if the Gauss-Newton step still to go is shorter than so many deviations,
    else coarse; infinite: always exact; 0: always coarse, and good enough to end with."""

    @classmethod
    def of(cls, problem: Problem, z: Array, inflation: float | None = None) -> Objective:
        """Makes the objective of all readings z (trials, m), with the prior, if given, its
        deviations times `inflation`."""
        model = CountingModel(problem.measurement, EvaluationCount.zeros(len(z)))
        prior = None if inflation is None else problem.prior_covariance(inflation)
        return cls(model, problem.R, z, np.arange(len(z)), problem.x0, prior)

    @property
    def readings(self) -> int:
        return self.z.shape[1]

    def residual(self, x: Array) -> Array:
        """Computes whitened residuals (trials, m), followed by those of the prior (trials, n) where
        it counts."""
        r = self.R.whiten(self.model.residual(x, self.rows, self.z))
        if self.prior is None:
            return r
        return np.concatenate([r, self.prior.whiten(x - self.x0)], axis=1)

    def cost(self, x: Array, r: Array) -> Array:
        """Returns the objective (trials,) at x, where the residuals are r: half its gradient is J'
        r."""
        return squared(r)

    def jacobian(self, x: Array, *, coarse: Mask | bool = False) -> Array:
        """Computes the derivative of the residuals (trials, m, n) or (trials, m + n, n); where
        `coarse` (trials,) says so, one that is near enough for steps."""
        J = self.R.whiten_jacobian(self.model.jacobian(x, self.rows, coarse=coarse))
        if self.prior is None:
            return J
        n = x.shape[1]
        rows = self.prior.whiten_jacobian(np.eye(n))
        return np.concatenate([J, np.broadcast_to(rows, (len(x), n, n))], axis=1)

    def coarsened(self, exact_within: float) -> Objective:
        """Returns the objective with coarse Jacobians where steps are longer, if the model has any
        that are cheaper."""
        cheaper = self.model.coarse_share < 1.0
        return dataclasses.replace(self, exact_within=exact_within if cheaper else np.inf)

    def subset(self, kept: Mask) -> Objective:
        if kept.dtype == bool and kept.all():
            return self
        x0 = self.x0[kept] if self.x0.ndim == 2 else self.x0
        return dataclasses.replace(self, z=self.z[kept], rows=self.rows[kept], x0=x0)


@dataclass(frozen=True)
class NormalEquations:
    """Factors J = Q U of each trial, and holds what a step needs of it."""

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
    """Its largest entry (trials,) in standard deviations of the local bound (J'J)^-1; infinite
    where J has not full rank."""
    stationary: Array
    """The largest part (trials,) of the residual along one column of J, in deviations: zero at a
    stationary point of whatever rank."""
    Q: Array | None = None
    """(trials, m, n), where a method asks for it."""

    @classmethod
    def of(cls, J: Array, r: Array, *, keep_Q: bool = False) -> NormalEquations:
        """Factors J (trials, m, n) for residuals r (trials, m)."""
        A = np.ascontiguousarray(J)
        with np.errstate(all="ignore"):
            # By the Cholesky factor of J'J where that keeps enough digits, else by QR below.
            U, inverse_U, well = definite_factor(gram(A))
            rows = np.ascontiguousarray(r)[:, None]
            along = np.matmul(rows, A)[:, 0]
            gradient = multiply(inverse_U.swapaxes(1, 2), along)
        well = well & finite(r)
        Q = np.matmul(A, inverse_U) if keep_Q else None
        if not well.all():
            ill = ~well
            Q_there, U[ill], inverse_U[ill], gradient[ill] = _orthogonal_factors(J[ill], r[ill])
            if Q is not None:
                Q[ill] = Q_there
        columns = np.sqrt((U**2).sum(axis=1))
        along = np.abs(multiply(U.swapaxes(1, 2), gradient))
        along_columns = along / divisors(columns)
        newton, size = _newton_step(inverse_U, gradient)
        stationary = along_columns.max(axis=1)
        return cls(U, inverse_U, gradient, columns, newton, size, stationary, Q)

    def towards(self, r: Array) -> NormalEquations:
        """Returns the same Jacobian with another residual r (trials, m): a chord. It needs Q."""
        assert self.Q is not None
        gradient = multiply(self.Q.swapaxes(1, 2), r)
        newton, size = _newton_step(self.inverse_U, gradient)
        return dataclasses.replace(self, gradient=gradient, newton=newton, size=size)

    def damped(self, weights: Array) -> tuple[Array, Array]:
        """Computes the step that minimises |r + J s|^2 + |weights s|^2, and its predicted decrease
        of |r + J s|^2."""
        # An overflowing damping is treated by the other way.
        U_transposed = self.U.swapaxes(1, 2)
        damped = np.matmul(U_transposed, self.U)
        with np.errstate(over="ignore"):
            diagonal(damped)[...] += weights**2
        _, root, well = definite_factor(damped)
        # (U'U + D^2) s = -U'g, where the inverse of the matrix on the left is root root'.
        uphill = multiply(U_transposed, self.gradient)
        step = -multiply(root, multiply(root.swapaxes(1, 2), uphill))
        if not well.all():
            ill = ~well
            step[ill] = _damped_step(self.U[ill], weights[ill], self.gradient[ill])
        # |g|^2 - |g + U s|^2 = -(U s)' (2 g + U s).
        change = multiply(self.U, step)
        return step, -np.einsum("ti,ti->t", change, 2.0 * self.gradient + change)


def _newton_step(inverse_U: Array, gradient: Array) -> tuple[Array, Array]:
    """Computes the Gauss-Newton step (trials, n), and its largest entry (trials,) in deviations."""
    newton = -multiply(inverse_U, gradient)
    deviation = np.sqrt((inverse_U**2).sum(axis=2))
    size = np.abs(newton / deviation).max(axis=1)
    return newton, finite_or(np.inf, size)


def _damped_step(U: Array, weights: Array, gradient: Array) -> Array:
    """Computes the step that minimises |gradient + U s|^2 + |weights s|^2 for any U."""
    n = U.shape[1]
    damping = weights[:, :, None] * np.eye(n)
    Q, V = np.linalg.qr(np.concatenate([U, damping], axis=1))
    uphill = multiply(Q[:, :n].swapaxes(1, 2), gradient)
    return solve(V, -uphill)[0]


def _orthogonal_factors(J: Array, r: Array) -> tuple[Array, Array, Array, Array]:
    """Computes Q, U, U^-1 and Q' r for any J; U^-1 is NaN where J has not full rank."""
    _, m, n = J.shape
    # Fewer readings than parameters: rows of zeros keep U square, and deficient.
    missing = max(n - m, 0)
    J = np.pad(J, ((0, 0), (0, missing), (0, 0)))
    r = np.pad(r, ((0, 0), (0, missing)))
    usable = finite(J) & finite(r)
    Q, U = np.linalg.qr(np.where(usable[:, None, None], J, 0.0))
    # J lacks rank if a pivot is round-off, its columns brought to length 1.
    columns = np.sqrt(np.sum(U**2, axis=1))
    scaled = U / divisors(columns)[:, None, :]
    pivots = np.abs(np.diagonal(scaled, axis1=1, axis2=2))
    round_off = np.finfo(float).eps * max(m, n) * np.sqrt(n)
    deficient = ~usable | (pivots.min(axis=1) <= round_off)
    gradient = multiply(Q.swapaxes(1, 2), r)
    gradient = np.where(usable[:, None], gradient, np.nan)
    inverse_U, _ = inverse(np.where(deficient[:, None, None], np.nan, U))
    return Q[:, :m], U, inverse_U, gradient


def inverse_factor(J: Array) -> Array:
    """Computes U^-1 (trials, n, n) of J = Q U (trials, m, n): (J'J)^-1 = U^-1 U^-T; NaN where J
    lacks full rank."""
    return _orthogonal_factors(J, np.zeros(J.shape[:2]))[2]


def slope_at(
    objective: Objective, x: Array, r: Array, exact: Mask, *, keep_Q: bool = False
) -> tuple[NormalEquations, Mask]:
    """Computes the slope at x, where the residuals are r, and whether it is exact: where `exact`
    (trials,) says so, and where a coarse Jacobian has not full rank."""
    slope = NormalEquations.of(objective.jacobian(x, coarse=~exact), r, keep_Q=keep_Q)
    lost = ~exact & ~np.isfinite(slope.size)
    if lost.any():
        part = objective.subset(lost)
        all_exact = np.ones(lost.sum(), dtype=bool)
        again, _ = slope_at(part, x[lost], r[lost], all_exact, keep_Q=keep_Q)
        slope = put(slope, lost, again)
    return slope, exact | lost


@dataclass(frozen=True)
class LeastSquaresSystem:
    """Holds the state of these methods; every field has the trials in front."""

    x: Array
    r: Array
    """Whitened residuals, those of the prior included."""
    cost: Array
    """The objective: |r|^2, unless it says otherwise."""
    slope: NormalEquations
    moved: Array
    """The last step, tried or taken, in standard deviations of the readings that it moves."""
    lam: Array
    growth: Array
    scale: Array
    """The scale of damped steps: the diagonal of D (trials, n)."""
    regular: Mask
    """True if J had full rank somewhere on the way: an end without it is then a place, no property
    of the problem."""
    mark: Array
    """The objective when it last decreased visibly."""
    idle: NDArray[np.int64]
    """Steps since the objective last decreased visibly."""
    exact: Mask
    """True if the slope is that of an exact Jacobian."""
    near: Mask
    """True if Jacobians are exact from now on, since the minimum is near."""

    @classmethod
    def at(
        cls, objective: Objective, x: Array, lam: float = 0.0, *, keep_Q: bool = False
    ) -> LeastSquaresSystem:
        """Returns the state at the start."""
        trials = len(x)
        r = objective.residual(x)
        cost = objective.cost(x, r)
        near = np.full(trials, np.isinf(objective.exact_within))
        slope, exact = slope_at(objective, x, r, near, keep_Q=keep_Q)
        return cls(
            x=x,
            r=r,
            cost=cost,
            slope=slope,
            moved=np.full(trials, np.inf),
            lam=np.full(trials, lam),
            growth=np.full(trials, 2.0),
            scale=divisors(slope.columns),
            regular=np.isfinite(slope.size),
            mark=cost,
            idle=np.zeros(trials, np.int64),
            exact=exact,
            near=near,
        )

    def nearly(self, objective: Objective) -> Mask:
        """Tells whether the next Jacobian (trials,) is to be exact, and all after it."""
        return self.near | (self.slope.size < objective.exact_within)

    def reach(self, step: Array) -> Array:
        """Computes the length (trials,) of a step in standard deviations of the readings that it
        moves."""
        return np.abs(step * self.slope.columns).max(axis=1)

    def watched(self, cost: Array) -> tuple[Array, NDArray[np.int64]]:
        """Updates `mark` and `idle` after a step to an objective of that cost."""
        visible = cost < self.mark * (1 - _VISIBLE)
        mark = np.where(visible, cost, self.mark)
        return mark, np.where(visible, 0, self.idle + 1)

    @property
    def rankless(self) -> Mask:
        """Tells whether J lacks full rank (trials,)."""
        return ~np.isfinite(self.slope.size)

    def check(self, objective: Objective, stuck: Mask) -> ConvergenceCheck:
        """Measures the gradient by the Gauss-Newton step still to go, if J is good enough to end
        with, and divergence by the cost."""
        known = np.isfinite(self.cost) & finite(self.slope.gradient)
        growth = np.where(known, np.sqrt(self.cost), np.nan)
        ending = np.where(self.rankless, Status.SINGULAR, Status.STALLED)
        size = np.where(self.rankless & self.regular, self.slope.stationary, self.slope.size)
        # Where nothing can be gained the answer is there, however badly the Jacobian or round-off
        # behaves.
        settled = (self.idle >= _FLAT) & (self.slope.stationary <= _STATIONARY) & self.regular
        size = np.where(settled, 0.0, size)
        if objective.exact_within > 0:
            size = np.where(self.exact, size, np.inf)
        return ConvergenceCheck(size, growth, self.moved, stuck, ending)
