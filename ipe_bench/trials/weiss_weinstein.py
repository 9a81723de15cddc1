"""Where any estimator must break: a bound that knows of false roots.

The Weiss-Weinstein bound (Weiss and Weinstein, IEEE Trans. Information Theory 31, 1985) with the exponent 1/2, for
normal noise and a normal prior. Its test points are infinitesimal steps, which alone make it Van Trees's bound, and
offsets to other places whose readings are alike: where noise may take one for the other, no estimator can tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from ipe_bench.basics.linalg import Array, deviations, information
from ipe_bench.estimators.least_squares import inverse_factor
from ipe_bench.measurements.problem import Problem
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.thresholds import EXPECTED

_SEEN = 1e-6
"""Offsets at which the readings of no truth are alike with at least this weight say nothing."""
_APART = 1.0
"""Roots nearer than this, in deviations of the bound, are one."""
_TRUTHS, _STARTS = 4, 4
"""Starts for each truth, and truths, from which false roots are looked for."""


@dataclass(frozen=True)
class Threshold:
    """What no estimator can beat on average over the prior, and the false roots that were found."""

    van_trees: Array
    """Deviations (n,) of Van Trees's bound, which knows nothing of false roots."""
    weiss_weinstein: Array
    """The same of the Weiss-Weinstein bound, with the offsets of the false roots; never below it."""
    false_roots: int
    runs: int
    """Runs of least squares that ended in a false root, and all of them."""
    nearest: float
    """How far the readings of the nearest false root are from the truth's, in deviations; infinite where there is
    none."""

    @property
    def confusion(self) -> float:
        """The chance that noise makes the readings fit that root better than the truth."""
        return float(ndtr(-self.nearest / 2))


def threshold(scenario: Scenario) -> Threshold | None:
    """False roots of the scenario's first truths, from others as starts, and what they mean for any estimator; None
    where there is no prior."""
    problem = scenario.problem
    if problem.prior_deviation is None:
        return None
    u = scenario.truths(0, EXPECTED)
    x, starts = u[:_TRUTHS], u[_TRUTHS : _TRUTHS + _STARTS]
    with np.errstate(all="ignore"):
        J = problem.measurement.jacobian(u)
        expected = information(J, problem.R).mean(axis=0)
        bound = np.sqrt(np.sum(inverse_factor(problem.R.whiten_jacobian(J[:_TRUTHS])) ** 2, axis=2))
        offsets, apart = false_roots(problem, x, starts, bound)
        local, whole = (weiss_weinstein(problem, expected, c, u) for c in (offsets[:0], offsets))
    nearest = float(apart[0]) if len(apart) else np.inf
    # The estimated bound with more test points is never the smaller one but for round-off.
    together = np.maximum(deviations(whole), deviations(local))
    return Threshold(deviations(local), together, len(apart), _TRUTHS * _STARTS, nearest)


def weiss_weinstein(problem: Problem, information: Array, offsets: Array, u: Array) -> Array:
    """The bound (n, n) on the mean of e e' over the prior, e the error of any estimator, biased or not.

    `information` (n, n) is E[J' R^-1 J], `offsets` (k, n) are test points, and means over the prior are those over its
    draws u (draws, n).
    """
    assert problem.prior_deviation is not None
    n = u.shape[1]
    offsets = _telling(problem, offsets, u)
    k = len(offsets)
    G = np.zeros((n + k, n + k))
    G[:n, :n] = information + problem.prior_covariance().inverse()  # type: ignore[union-attr]
    alike = [_alike(problem, c, u) for c in offsets]
    for i in range(k):
        G[n + i, :n] = G[:n, n + i] = -4 * alike[i][1] / alike[i][0]
        for j in range(i + 1):
            pair = [_alike(problem, offsets[i] + sign * offsets[j], u)[0] for sign in (-1.0, 1.0)]
            G[n + i, n + j] = G[n + j, n + i] = 2 * (pair[0] - pair[1]) / (alike[i][0] * alike[j][0])
    H = np.concatenate([np.eye(n), offsets.T], axis=1)
    scale = np.sqrt(np.diag(G))
    return np.asarray((H / scale) @ np.linalg.pinv(G / np.outer(scale, scale), hermitian=True) @ (H / scale).T)


def _telling(problem: Problem, offsets: Array, u: Array) -> Array:
    """The offsets at which readings are ever alike, each once; the most alike first, and no more than there are
    parameters."""
    weights = np.array([_alike(problem, c, u)[0] for c in offsets])
    kept: list[Array] = []
    for i in np.argsort(-weights, kind="stable"):
        if weights[i] > _SEEN and not any(
            np.allclose(offsets[i], sign * c, rtol=1e-3) for c in kept for sign in (-1, 1)
        ):
            kept.append(offsets[i])
    return np.array(kept[: offsets.shape[1]]).reshape(-1, offsets.shape[1])


def _alike(problem: Problem, c: Array, u: Array) -> tuple[float, Array]:
    """How alike truths are that lie an offset c apart, and its gradient (n,) in c: the mean of
    sqrt(p(z, x + c) p(z, x)) over all z and x.

    For a normal prior that is exp(-|c|^2 / 8) in its metric, times the mean over the prior's u of
    exp(-|h(u + c/2) - h(u - c/2)|^2 / 8) in the metric of R.
    """
    model, prior = problem.measurement, problem.prior_covariance()
    assert prior is not None
    above, below = u + c / 2, u - c / 2
    with np.errstate(all="ignore"):
        apart = problem.R.whiten(model.simulate(above) - model.simulate(below))
        weight = np.exp(-np.sum(apart**2, axis=1) / 8 - np.sum(prior.whiten(c) ** 2) / 8)
    weight = np.where(np.isfinite(weight), weight, 0.0)
    slope, used = np.zeros(len(c)), weight > 0
    if used.any():
        both = problem.R.whiten_jacobian(model.jacobian(above[used]) + model.jacobian(below[used]))
        fall = -np.einsum("tmi,tm->ti", both, apart[used]) / 8 - prior.inverse() @ c / 4
        slope = np.sum(weight[used, None] * fall, axis=0) / len(u)
    return float(weight.mean()), slope


def false_roots(problem: Problem, x: Array, starts: Array, bound: Array) -> tuple[Array, Array]:
    """Other minima of the least-squares objective, for the error-free readings of truths x (truths, n), that are
    reached from `starts` (starts, n): offsets from the truth (k, n), and how far apart the readings are (k,), in
    deviations, the nearest first. `bound` (truths, n) are the deviations of the Cramér-Rao bound.
    """
    h = problem.measurement.simulate(x)
    found, apart = [], []
    for start in starts:
        root = least_squares_root(problem, h, np.broadcast_to(start, x.shape).copy(), None, prior=None)
        with np.errstate(all="ignore"):
            away = (np.abs(root - x) / bound).max(axis=1) > _APART
        for i in np.flatnonzero(away & np.isfinite(root).all(axis=1)):
            found.append(root[i] - x[i])
            between = problem.R.whiten(problem.measurement.simulate(root[i : i + 1])[0] - h[i])
            apart.append(float(np.sqrt(np.sum(between**2))))
    order = np.argsort(apart, kind="stable")
    return np.array(found).reshape(-1, x.shape[1])[order], np.array(apart)[order]
