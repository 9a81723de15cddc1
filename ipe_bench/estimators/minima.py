"""Minimises least squares, tests whether minima fit, and tells which of them are the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, deviations, finite, from_root, inverse, squared
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates
from ipe_bench.estimators.driver import Limits, Method, SolveResult, iterate
from ipe_bench.estimators.least_squares import (
    LeastSquaresSystem,
    NormalEquations,
    Objective,
    slope_at,
)
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem

_EXACT_WITHIN = 0.03
"""Steps still to go of fewer deviations are computed from exact Jacobians: a coarse one leaves the
gradient about a hundredth of a deviation from zero."""
WRONG_MINIMUM = 1e-6
"""Residuals less probable than this are taken for those of a wrong minimum: far less than those of
a misfit."""
_APART = 0.1
"""Two minima further apart than this, in standard deviations of the local bound, are two."""


@dataclass(frozen=True)
class Minima:
    """The end of the minimisation of each trial, with what is known of the objective there."""

    x: Array
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]
    history: list[Array] | None
    covariance: Array
    """(J' R^-1 J)^-1 (trials, n, n), with P0^-1 inside where the prior counts; NaN where it does
    not exist."""
    chi_square: Array
    """|R^-1/2 (h(x) - z)|^2 (trials,), of the readings alone."""
    bulk: Array
    """The median magnitude (trials,) of the readings' residuals in deviations: .67 where R is
    right, and little more where it is wrong for some of them only."""

    @classmethod
    def of(cls, ended: SolveResult[Any], covariance: Array, r: Array) -> Minima:
        """Makes the minima of an iteration that has ended, with whitened residuals r (trials, m)
        there."""
        return cls(
            ended.x,
            ended.status,
            ended.iterations,
            ended.history,
            covariance,
            chi_square=squared(r),
            bulk=np.median(np.abs(r), axis=1),
        )

    @classmethod
    def nowhere(cls, x: Array, history: bool) -> Minima:
        """Marks every trial as without a minimum, at its start x (trials, n)."""
        trials, n = x.shape
        far = np.full(trials, np.inf)
        return cls(
            x,
            status=np.full(trials, Status.MAX_ITERATIONS, np.int8),
            iterations=np.zeros(trials, np.int64),
            history=[row[None] for row in x] if history else None,
            covariance=np.full((trials, n, n), np.nan),
            chi_square=far,
            bulk=far,
        )

    @property
    def converged(self) -> Mask:
        return self.status == Status.CONVERGED

    def better_than(self, old: Minima) -> Mask:
        """Tells which replace the old ones: they converged and are lower, or the old one had no
        end."""
        return self.converged & (~(self.chi_square >= old.chi_square) | ~old.converged)

    def replaced(self, rows: NDArray[np.intp], again: Minima, better: Mask) -> Minima:
        """Replaces the minima of the trials `rows` by further ones `again` where `better`;
        iterations add up."""
        spent = self.iterations.copy()
        spent[rows] += again.iterations
        found = put(self, rows[better], take(again, better))
        return replace(found, iterations=spent)

    def fit_probability(self, readings: int) -> Array:
        """Computes the chi-square test of the fit (trials,): how probable residuals at least this
        large are if the model holds, R is right and the minimum is the global one."""
        from scipy.special import chdtrc

        return chdtrc(max(readings - self.x.shape[1], 1), self.chi_square)

    def estimates(self, tally: EvaluationCount, readings: int) -> Estimates:
        """Makes the estimates of an estimator that ends here."""
        extras = {"fit_p": self.fit_probability(readings)}
        return Estimates.of(self, tally, covariance=self.covariance, extras=extras)


def minimize(
    objective: Objective, method: Method[Objective, LeastSquaresSystem], x: Array, limits: Limits
) -> Minima:
    """Minimises the objective from x (trials, n), by coarse Jacobians on the way if the model has
    any that are cheaper.

    Converged is where the Gauss-Newton step, which is the gradient in whitened units, is at most
    `limits.tolerance` standard deviations of the local bound in every parameter. An iteration is a
    step tried, taken or not.
    """
    if np.isinf(objective.exact_within):
        objective = objective.coarsened(_EXACT_WITHIN)
    ended = iterate(objective, method, x, limits)
    return minima_of(ended, _exact_slope(objective, ended.state), objective.readings)


def minima_of(ended: SolveResult[Any], slope: NormalEquations, readings: int) -> Minima:
    """Makes the minima of an iteration that has ended with that slope."""
    inverse_U = slope.inverse_U
    lost = ~finite(inverse_U)
    if lost.any():
        inverse_there, _ = inverse(slope.U[lost])
        inverse_U = put(inverse_U, lost, inverse_there)
    # U^-1 U^-T: inverting U'U would lose twice the digits, and with them the sign of a variance.
    covariance = from_root(inverse_U)
    return Minima.of(ended, covariance, ended.state.r[:, :readings])


def _exact_slope(objective: Objective, state: LeastSquaresSystem) -> NormalEquations:
    """Returns the slope at the end of an iteration; evaluated for the report where that is a coarse
    one."""
    coarse = ~state.exact & finite(state.x)
    if objective.exact_within == 0 or not coarse.any():
        return state.slope
    report = replace(objective, model=objective.model.reporting()).subset(coarse)
    x = state.x[coarse]
    everywhere = np.ones(len(x), dtype=bool)
    keep_Q = state.slope.Q is not None
    exact, _ = slope_at(report, x, state.r[coarse], everywhere, keep_Q=keep_Q)
    return put(state.slope, coarse, exact)


@dataclass(frozen=True)
class Fitting:
    """Collects the distinct minima that pass the test of the fit, for the trials of a batch."""

    readings: int
    known: list[list[Array]]
    """The minima of each trial, in the order in which they were found."""

    @classmethod
    def none(cls, trials: int, readings: int) -> Fitting:
        return cls(readings, [[] for _ in range(trials)])

    def note(self, found: Minima, rows: NDArray[np.intp]) -> Mask:
        """Adds the minima of the trials `rows` that fit and are not known yet, and says which of
        them fit."""
        fits: Mask = found.converged & passes(found, self.readings, WRONG_MINIMUM)
        deviation = deviations(found.covariance)
        for i in np.flatnonzero(fits):
            known = self.known[rows[i]]
            if all(_apart(x, found.x[i], deviation[i]) for x in known):
                known.append(found.x[i])
        return fits

    def counts(self, rows: NDArray[np.intp]) -> NDArray[np.int64]:
        """Counts the distinct minima of the trials `rows` that fit."""
        return np.array([len(self.known[i]) for i in rows], np.int64)

    def report(self, estimates: Estimates) -> Estimates:
        """Reports the estimates with the extras `minima`, the number of distinct ones that fit, and
        `ambiguous`, 1 where there are several; the others are their `alternatives`."""
        minima = self.counts(np.arange(len(self.known))).astype(float)
        estimates.extras |= {"minima": minima, "ambiguous": (minima > 1).astype(float)}
        assert estimates.covariance is not None
        deviation = deviations(estimates.covariance)
        alternatives = []
        for known, x, d in zip(self.known, estimates.x, deviation, strict=True):
            others = [other for other in known if _apart(other, x, d)]
            alternatives.append(np.array(others).reshape(-1, len(x)))
        estimates.alternatives = alternatives
        return estimates


def passes(found: Minima, readings: int, significance: float) -> Mask:
    """Tells which minima (trials,) pass the test of the fit; none at a significance of 1: residuals
    say nothing."""
    return (found.fit_probability(readings) >= significance) & (significance < 1)


def spread_of_starts(problem: Problem) -> Array:
    """Computes standard deviations (n,) of random starts about the start: those of the
    prior where one is known, else the size of the start, or 1 where that is zero."""
    if problem.prior_deviation is not None:
        return problem.prior_deviation
    return np.where(problem.x0 == 0, 1.0, np.abs(problem.x0))


def _apart(a: Array, b: Array, deviation: Array) -> bool:
    """Tells whether two minima (n,) are two."""
    distance = (np.abs(a - b) / deviation).max()
    return bool(distance > _APART)
