"""Minima that fit the readings alike, which no test of residuals can tell apart, counted and listed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask, deviations
from ipe_bench.estimators.base import Estimates
from ipe_bench.estimators.least_squares import Minima
from ipe_bench.measurements.problem import Problem

WRONG_MINIMUM = 1e-6
"""Residuals less probable than this are taken for those of a wrong minimum: far less than those of a misfit."""
_APART = 0.1
"""Two minima further apart than this, in standard deviations of the local bound, are two."""


@dataclass(frozen=True)
class Fitting:
    """The distinct minima that pass the test of the fit, for the trials of a batch."""

    readings: int
    known: list[list[Array]]
    """Of each trial, in the order in which they were found."""

    @classmethod
    def none(cls, trials: int, readings: int) -> Fitting:
        return cls(readings, [[] for _ in range(trials)])

    def note(self, found: Minima, rows: NDArray[np.intp]) -> Mask:
        """Adds the minima of the trials `rows` that fit and are not known yet, and says which of them fit."""
        fits: Mask = found.converged & passes(found, self.readings, WRONG_MINIMUM)
        deviation = deviations(found.covariance)
        for i in np.flatnonzero(fits):
            known = self.known[rows[i]]
            if all(_apart(x, found.x[i], deviation[i]) for x in known):
                known.append(found.x[i])
        return fits

    def report(self, estimates: Estimates) -> Estimates:
        """The estimates with the extras `minima`, the number of distinct ones that fit, and `ambiguous`, 1 where there
        are several; the others are their `alternatives`."""
        minima = np.array([len(known) for known in self.known], dtype=float)
        estimates.extras |= {"minima": minima, "ambiguous": (minima > 1).astype(float)}
        assert estimates.covariance is not None
        deviation = deviations(estimates.covariance)
        estimates.alternatives = [
            np.array([other for other in known if _apart(other, x, d)]).reshape(-1, len(x))
            for known, x, d in zip(self.known, estimates.x, deviation, strict=True)
        ]
        return estimates


def passes(found: Minima, readings: int, level: float) -> Mask:
    """Which minima (trials,) pass the test of the fit at a level; none at 1, where their residuals say nothing."""
    return (found.fit_probability(readings) >= level) & (level < 1)


def spread_of_starts(problem: Problem) -> Array:
    """Standard deviations (n,) of random starts about the nominal point: those of the prior where one is known, else
    the size of the nominal point, or 1 where that is zero."""
    if problem.prior_deviation is not None:
        return problem.prior_deviation
    return np.where(problem.x0 == 0, 1.0, np.abs(problem.x0))


def _apart(a: Array, b: Array, deviation: Array) -> bool:
    """Whether two minima (n,) are two."""
    return bool((np.abs(a - b) / deviation).max() > _APART)
