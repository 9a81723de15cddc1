"""Least squares for a batch of trials: Gauss-Newton and Levenberg-Marquardt on whitened residuals, one loop for both.

Gauss-Newton, Levenberg-Marquardt, MAP, and the re-linearised and progressive forms of IPE share this module; what each
of them starts from, fits and reports is left to it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from ipe_bench.estimation import Estimates
from ipe_bench.ipe import Counted, Roots, Tally
from ipe_bench.linalg import Array, Covariance, Mask, finite, inverse, multiply, solve
from ipe_bench.scenario import Problem
from ipe_bench.statuses import Status

_FAR = 1e8
"""Residuals this many times larger than at the start mean divergence."""
_TINY_STEP = 1e-3
"""Steps below this share of the tolerance, while the gradient is above it, mean a stall."""
_LARGEST_DAMPING = 1e30
_FIXED = 1e-9
"""A prior deviation of zero is taken for this share of the largest."""
_ROUND_OFF = 1e-8
"""A predicted decrease below this share of the objective cannot be seen in the objective any more."""


@dataclass(frozen=True)
class Objective:
    """|R^-1/2 (h(x) - z)|^2, plus |(x - x0) / prior_deviation|^2 where a prior counts, for the trials `rows`."""

    model: Counted
    R: Covariance
    z: Array
    rows: NDArray[np.intp]
    x0: Array
    prior_deviation: Array | None = None

    @classmethod
    def of(cls, problem: Problem, z: Array, *, prior: bool, inflation: float = 1.0) -> Objective:
        """The objective of all readings z (trials, m); with the prior, its deviations times `inflation`."""
        model = Counted(problem.measurement, Tally.zeros(len(z)))
        deviation = prior_deviation(problem, inflation) if prior else None
        return cls(model, problem.R, z, np.arange(len(z)), problem.x0, deviation)

    @property
    def readings(self) -> int:
        return self.z.shape[1]

    def residual(self, x: Array) -> Array:
        """Whitened residuals (trials, m), followed by those of the prior (trials, n) where it counts."""
        r = self.R.whiten(self.model.simulate(x, self.rows) - self.z)
        if self.prior_deviation is None:
            return r
        return np.concatenate([r, (x - self.x0) / self.prior_deviation], axis=1)

    def jacobian(self, x: Array) -> Array:
        """The derivative of the whitened residuals (trials, m, n) or (trials, m + n, n)."""
        J = self.R.whiten_jacobian(self.model.jacobian(x, self.rows))
        if self.prior_deviation is None:
            return J
        prior = np.broadcast_to(np.diag(1.0 / self.prior_deviation), (len(x), x.shape[1], x.shape[1]))
        return np.concatenate([J, prior], axis=1)

    def subset(self, kept: Mask) -> Objective:
        return dataclasses.replace(self, z=self.z[kept], rows=self.rows[kept])


def prior_deviation(problem: Problem, inflation: float = 1.0) -> Array | None:
    """The prior's standard deviations (n,) times `inflation`; a parameter that the prior fixes is nearly fixed."""
    deviation = problem.prior_deviation
    if deviation is None:
        return None
    return inflation * np.maximum(deviation, _FIXED * deviation.max())


@dataclass(frozen=True)
class Damping:
    """Levenberg-Marquardt: the step minimises |r + J s|^2 + lambda |D s|^2, and lambda follows the gain ratio.

    D = 1 / `deviation` (n,), the metric of a prior covariance; None: Marquardt's, the column norms of J, which only
    grow (More, in Numerical Analysis, LNM 630, 1978). lambda by Nielsen's rule (Madsen, Nielsen, Tingleff, Methods for
    Non-Linear Least Squares Problems, 2004, eq. 2.21).
    """

    initial: float
    deviation: Array | None = None


@dataclass
class Minima(Roots):
    """Where the minimisation of each trial ended, with what is known of the objective there."""

    covariance: Array
    """(J' R^-1 J)^-1 (trials, n, n), with P0^-1 inside where the prior counts; NaN where it does not exist."""
    chi_square: Array
    """|R^-1/2 (h(x) - z)|^2 (trials,), of the readings alone."""


@dataclass(frozen=True)
class _Factored:
    """J = Q U of each trial: all that a step needs to know of the Jacobian."""

    U: Array
    gradient: Array
    """Q' r (trials, n): the part of the residual that a step can remove."""
    columns: Array
    """Column norms of J (trials, n)."""
    newton: Array
    """The Gauss-Newton step (trials, n); NaN where J has not full rank."""
    size: Array
    """Its largest entry (trials,) in standard deviations of the local bound (J'J)^-1; infinite where J has not full
    rank."""

    @classmethod
    def of(cls, J: Array, r: Array) -> _Factored:
        missing = max(J.shape[2] - J.shape[1], 0)
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
        newton = -multiply(inverse_U, gradient)
        deviation = np.sqrt(np.sum(inverse_U**2, axis=2))
        size = np.abs(newton / deviation).max(axis=1)
        return cls(U, gradient, columns, newton, np.where(np.isfinite(size), size, np.inf))

    def damped(self, weights: Array) -> tuple[Array, Array]:
        """The step that minimises |r + J s|^2 + |weights s|^2, and the decrease of |r + J s|^2 + that it predicts."""
        n = self.U.shape[1]
        diagonal = weights[:, :, None] * np.eye(n)
        Q, U = np.linalg.qr(np.concatenate([self.U, diagonal], axis=1))
        step, _ = solve(U, -multiply(Q[:, :n].swapaxes(1, 2), self.gradient))
        change = multiply(self.U, step)
        return step, -np.einsum("ti,ti->t", change, 2.0 * self.gradient + change)

    def __getitem__(self, kept: Mask) -> _Factored:
        return _Factored(*(getattr(self, f.name)[kept] for f in dataclasses.fields(self)))

    def replaced(self, where: Mask, by: _Factored) -> _Factored:
        """The same with the trials `where` taken from another."""
        parts = []
        for f in dataclasses.fields(self):
            values = getattr(self, f.name).copy()
            values[where] = getattr(by, f.name)
            parts.append(values)
        return _Factored(*parts)


def minimize(
    objective: Objective,
    x: Array,
    *,
    damping: Damping | None,
    tolerance: float,
    max_iterations: int,
    budget: float = np.inf,
    history: bool = False,
) -> Minima:
    """Minimises the objective from x (trials, n): Gauss-Newton without damping, Levenberg-Marquardt with it.

    Converged is where the Gauss-Newton step, which is the gradient in whitened units, is at most `tolerance` standard
    deviations of the local bound in every parameter. `budget` bounds the simulations of a trial, a Jacobian counting n.
    Finished trials leave the batch. An iteration is a step tried, taken or not.
    """
    trials, n = x.shape
    tally = objective.model.tally
    status = np.full(trials, Status.RUNNING, np.int8)
    result = Minima(
        x.copy(), status, np.zeros(trials, np.int64), None, np.full((trials, n, n), np.nan), np.full(trials, np.nan)
    )
    iterates = [[row] for row in x] if history else None
    active = np.arange(trials)
    x = x.copy()
    r = objective.residual(x)
    local = _Factored.of(objective.jacobian(x), r)
    cost = _squared(r)
    begun = np.maximum(cost, 1.0)
    scale = _scale(damping, local, None)
    lam = np.full(trials, damping.initial if damping else 0.0)
    growth = np.full(trials, 2.0)
    step_size = np.full(trials, np.inf)

    for iteration in range(max_iterations + 1):
        if iteration:
            step, predicted = local.damped(np.sqrt(lam)[:, None] * scale) if damping else (local.newton, np.zeros(1))
            r_new = objective.residual(x + step)
            cost_new = _squared(r_new)
            if damping:
                gain = (cost - cost_new) / predicted
                invisible = (predicted <= _ROUND_OFF * cost) & (np.abs(cost_new - cost) <= 2 * _ROUND_OFF * cost)
                taken = (gain > 0) | invisible
                eased = lam * np.maximum(1 / 3, 1 - (2 * np.clip(np.where(invisible, 1.0, gain), 0, 1) - 1) ** 3)
                lam, growth = np.where(taken, eased, lam * growth), np.where(taken, 2.0, 2.0 * growth)
            else:
                taken = np.ones(len(x), dtype=bool)
            step_size = np.abs(step * np.linalg.norm(local.U, axis=1)).max(axis=1)
            x = np.where(taken[:, None], x + step, x)
            r = np.where(taken[:, None], r_new, r)
            cost = np.where(taken, cost_new, cost)
            if taken.any():
                there = objective.subset(taken)
                local = local.replaced(taken, _Factored.of(there.jacobian(x[taken]), r[taken]))
                scale = _scale(damping, local, scale)
            result.x[active] = x
            result.iterations[active] = iteration
            if iterates is not None:
                for row, value in zip(active, x, strict=True):
                    iterates[row].append(value)
        spent = tally.simulations[objective.rows] + n * tally.jacobians[objective.rows]
        stuck = (step_size < _TINY_STEP * tolerance) | (lam > _LARGEST_DAMPING)
        singular = ~np.isfinite(local.size)
        now = np.select(
            [
                np.isin(objective.rows, list(tally.messages)),
                ~np.isfinite(cost) | ~finite(local.gradient),
                local.size <= tolerance,
                singular & (stuck if damping else True),
                cost > _FAR**2 * begun,
                stuck,
                spent >= budget,
            ],
            [
                Status.ERROR,
                Status.NONFINITE,
                Status.CONVERGED,
                Status.SINGULAR,
                Status.DIVERGED,
                Status.STALLED,
                Status.BUDGET,
            ],
            Status.MAX_ITERATIONS if iteration == max_iterations else Status.RUNNING,
        )
        result.status[active] = now
        going = now == Status.RUNNING
        done = ~going
        if done.any():
            # U^-1 U^-T: inverting U'U would lose twice the digits, and with them the sign of a variance.
            inverse_U, _ = inverse(local.U[done])
            result.covariance[active[done]] = np.matmul(inverse_U, inverse_U.swapaxes(1, 2))
            result.chi_square[active[done]] = _squared(r[done, : objective.readings])
        if not going.any():
            break
        if done.any():
            active, objective, local = active[going], objective.subset(going), local[going]
            x, r, cost, begun, lam, growth = (a[going] for a in (x, r, cost, begun, lam, growth))
            scale = scale[going]
    if iterates is not None:
        result.history = [np.array(rows) for rows in iterates]
    return result


def _squared(r: Array) -> Array:
    return np.einsum("ti,ti->t", r, r)


def _scale(damping: Damping | None, local: _Factored, before: Array | None) -> Array:
    """The diagonal of D (trials, n)."""
    if damping is not None and damping.deviation is not None:
        return np.broadcast_to(1.0 / damping.deviation, local.columns.shape)
    if before is None:
        return np.where(local.columns > 0, local.columns, 1.0)
    return np.fmax(before, local.columns)


def fit_probability(minima: Minima, readings: int) -> Array:
    """The chi-square test of the fit (trials,): how probable residuals at least this large are if the model holds, R is
    right and the minimum is the global one."""
    n = minima.x.shape[1]
    return chdtrc(max(readings - n, 1), minima.chi_square)


def report(minima: Minima, tally: Tally, readings: int) -> Estimates:
    """What an estimator hands back: the covariance is (J' R^-1 J)^-1, with P0^-1 inside where the prior counts."""
    return Estimates(
        x=minima.x,
        status=minima.status,
        covariance=minima.covariance,
        iterations=minima.iterations,
        simulations=tally.simulations.copy(),
        jacobians=tally.jacobians.copy(),
        messages=dict(tally.messages),
        history=minima.history,
        extras={"fit_p": fit_probability(minima, readings)},
    )
