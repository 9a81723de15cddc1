"""What theory says of one iteration or one estimate, beside what happened: contraction, orders of convergence, bounds.

Every function takes arrays with a leading trials axis, or a history of one trial, and returns a frozen dataclass; the
equations are those of the paper. Rendering is left to the report.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, information, inverse, multiply
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class FixedPointBound:
    """Eq. (18) against what happened, for one trial. Each is (iterates,), in the largest parameter error."""

    bound: Array
    """K^k / (1 - K) |x_1 - x_0|, infinite where K >= 1. The paper's print lost the k (Burden and Faires have it)."""
    error: Array
    """|x_k - root|."""

    @property
    def holds(self) -> bool:
        """Whether no iterate is farther from the root than the bound (and round-off) allows."""
        return bool(np.all(self.error <= self.bound + 1e-12 * (1.0 + self.error.max())))


def fixed_point_bound(iterates: Array, root: Array, K: float) -> FixedPointBound:
    """Eq. (18) for iterates (iterates, n) with a constant K that holds along them, such as the largest of
    `contraction(...)` over the region; at a single point K is no proven bound."""
    step = np.abs(iterates[1] - iterates[0]).max()
    powers = K ** np.arange(len(iterates))
    bound = powers / (1 - K) * step if K < 1 else np.full(len(iterates), np.inf)
    return FixedPointBound(bound, np.abs(iterates - root).max(axis=1))


@dataclass(frozen=True)
class Order:
    """Observed order of convergence of one trial."""

    errors: Array
    """|x_k - root| (iterates,) in the weights given."""
    orders: Array
    """log(e_(k+1) / e_k) / log(e_k / e_(k-1)) for each k where the errors are above the floor and decrease."""

    @property
    def order(self) -> float:
        """The last of the orders, nearest to the asymptotic one: 1 linear, 2 quadratic; NaN with fewer than three
        usable errors."""
        return float(self.orders[-1]) if len(self.orders) else np.nan

    @property
    def rate(self) -> float:
        """The last ratio of successive errors: the contraction where the order is 1."""
        usable = np.flatnonzero(self.errors > 0)
        return float(self.errors[usable[-1]] / self.errors[usable[-2]]) if len(usable) > 1 else np.nan


def order_of_convergence(iterates: Array, root: Array, deviation: Array | float = 1.0, floor: float = 1e-9) -> Order:
    """The order from the iterates (iterates, n) of one trial and its root (n,), in units of `deviation`.

    The root must be known better than the last iterate that counts: take the one that Newton's method polished. Errors
    below `floor` are round-off and left out.
    """
    errors = np.abs((iterates - root) / deviation).max(axis=1)
    return Order(errors, orders_of(errors, floor))


def orders_of(errors: Array, floor: float = 1e-9) -> Array:
    """log(e_(k+1) / e_k) / log(e_k / e_(k-1)) of successive errors (iterates,), where they decrease above the floor."""
    e = errors[: int(np.argmax(errors <= floor)) if (errors <= floor).any() else len(errors)]
    with np.errstate(divide="ignore", invalid="ignore"):
        orders = np.log(e[2:] / e[1:-1]) / np.log(e[1:-1] / e[:-2])
    decreasing = (e[2:] < e[1:-1]) & (e[1:-1] < e[:-2])
    return orders[decreasing]


@dataclass(frozen=True)
class QuadraticConstant:
    """The constant of eq. (23), |x_(k+1) - root| <= n^2 M / 2 |x_k - root|^2, two ways."""

    observed: float
    """The largest 2 e_(k+1) / (n^2 e_k^2) over the iterates above the floor: the least M that explains the history."""
    M: float
    """The largest abs(d2 g_i / dx_j dx_k) of Newton's g at the root, where d2g = J_F^-1 d2F, by central differences of
    J_F. The theorem wants the largest over a neighbourhood, which this only estimates."""


def quadratic_constant(problem: Problem, iterates: Array, root: Array, floor: float = 1e-9) -> QuadraticConstant:
    """Eq. (23) for iterates (iterates, n) of Newton's method on the frozen equation, in multiples of the units."""
    n = len(root)
    size = 1e-4 * np.maximum(1.0, np.abs(root))
    around = np.concatenate([root + np.diag(size), root - np.diag(size), root[None]])
    J = FrozenSystem.at_nominal(problem, np.zeros((len(around), problem.measurement.m))).J(around)
    second = (J[:n] - J[n : 2 * n]) / (2 * size)[:, None, None]  # (k, i, j): d2F_i / dx_j dx_k
    bent = np.matmul(np.linalg.inv(J[-1]), second)
    errors = np.abs(iterates - root).max(axis=1)
    usable = (errors[:-1] > floor) & (errors[1:] > floor)
    ratios = 2 * errors[1:][usable] / (n**2 * errors[:-1][usable] ** 2)
    return QuadraticConstant(float(ratios.max()) if len(ratios) else np.nan, float(np.abs(bent).max()))


@dataclass(frozen=True)
class Covariances:
    """Five answers to how well the frozen root is known, for the solved trials of one scenario. Each is (n, n)."""

    linear: Array
    """Eq. (5), H+ R H+'."""
    compensation: Array
    """Eq. (14): eq. (5) plus H+ E[dN dN'] H+' with dN = N(x) - N(x^). It takes dN for independent of v, but x^ is made
    from v: to first order dN is linear in v, and the cross terms that eq. (14) leaves out are of the same order."""
    sandwich: Array
    """(H+ J)^-1 H+ R H+' (H+ J)^-T, the mean over trials at the estimates: eq. (14) with the cross terms, to first
    order."""
    crlb: Array
    """(J' R^-1 J)^-1, the mean over trials at the truths: what no unbiased estimator can beat."""
    monte_carlo: Array
    """The mean of e e' over the solved trials."""
    trials: int


def covariances(problem: Problem, estimates: Array, truths: Array, solved: Mask) -> Covariances:
    """The covariances from estimates and truths (trials, n), over the trials that are solved (trials,).

    E[dN dN'] of eq. (14) is the mean over these trials.
    """
    x, truth = estimates[solved], truths[solved]
    model = problem.measurement
    system = FrozenSystem.at_nominal(problem, np.zeros((len(x), model.m)))
    linear = system.covariance()[0]
    difference = model.simulate(truth) - model.simulate(x) - np.matmul(problem.H, (truth - x)[:, :, None])[:, :, 0]
    compensation = multiply(system.H_plus, difference)
    error = x - truth
    return Covariances(
        linear=linear,
        compensation=linear + _mean_square(compensation),
        sandwich=system.sandwich(x).mean(axis=0),
        crlb=inverse(information(model.jacobian(truth), problem.R))[0].mean(axis=0),
        monte_carlo=_mean_square(error),
        trials=len(x),
    )


def _mean_square(e: Array) -> Array:
    return np.einsum("ti,tj->ij", e, e) / max(len(e), 1)


@dataclass(frozen=True)
class FalseRoots:
    """Converged, and not where the same equation leads from the truth."""

    trials: Mask
    """(trials,)"""
    distance: Array
    """How far (trials,) from the root that the truth leads to, in the standard deviations given; NaN elsewhere."""

    @property
    def share(self) -> float:
        return float(self.trials.mean())


def false_roots(x: Array, status: Array, reference: Array, deviation: Array, tolerance: float = 1e-3) -> FalseRoots:
    """The false roots among estimates x (trials, n), given the reference roots and standard deviations (trials, n)."""
    distance = np.abs((x - reference) / deviation).max(axis=1)
    false = (np.asarray(status) == Status.CONVERGED) & ~(distance <= tolerance)
    return FalseRoots(false, np.where(false, distance, np.nan))


@dataclass(frozen=True)
class Convergence:
    """The curves of a convergence figure: error against iteration."""

    iteration: Array
    median: Array
    """Median over trials of the largest error in standard deviations, a finished trial keeping its last."""
    low: Array
    high: Array
    """5 % and 95 % quantiles."""


def convergence(histories: Sequence[Array], roots: Array, deviation: Array) -> Convergence:
    """Error against iteration from histories (iterates, n) of several trials and their roots (trials, n)."""
    longest = max(len(h) for h in histories)
    deviation = np.broadcast_to(deviation, roots.shape)
    errors = np.stack(
        [
            np.abs((h[np.minimum(np.arange(longest), len(h) - 1)] - root) / d).max(axis=1)
            for h, root, d in zip(histories, roots, deviation, strict=True)
        ]
    )
    errors = np.where(np.isfinite(errors), errors, np.inf)
    low, median, high = np.quantile(errors, [0.05, 0.5, 0.95], axis=0, method="nearest")
    return Convergence(np.arange(longest), median, low, high)
