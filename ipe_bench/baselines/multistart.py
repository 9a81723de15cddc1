"""Levenberg-Marquardt from many starts: the plainest way to look for a global minimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import take
from ipe_bench.basics.linalg import Array, Mask, finite
from ipe_bench.basics.options import Count, Positive, Whole
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Fitting, Minima, minimize, passes, spread_of_starts
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Multistart(Estimator):
    """Levenberg-Marquardt from the nominal point, then from draws of the prior, until the residuals pass the
    chi-square test; of all minima the lowest counts (Boender and Rinnooy Kan, Mathematical Programming 37, 1987).

    After the first fit `confirmations` further starts look for another minimum that fits. Extras: `minima`, how many
    distinct minima that fit were found, and `ambiguous`, 1 where there are several; `alternatives` lists the others.
    Damping is in the metric of the prior. Without a prior it is in Marquardt's, and starts are spread by the size of
    the nominal point.
    """

    starts: Count = 8
    confirmations: Whole = 2
    """Starts after the first fit, within `starts`."""
    damping: Positive = 1e-3
    """lambda at each start."""
    max_iterations: Count = 100
    """Steps tried from each start."""
    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step in standard deviations of the local bound."""
    seed: Whole = 0
    """A trial's random stream depends on this and on its readings: on nothing else in the batch."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z, prior=False)
        tally, x0, trials = objective.model.tally, problem.x0, len(z)
        draws = normals(own_generators(self.seed, z), self.starts - 1, len(x0))
        fitting = Fitting.none(trials, z.shape[1])

        def fits(found: Minima, rows: NDArray[np.intp]) -> Mask:
            """Which minima are believed; those that fit are noted."""
            return fitting.note(found, rows) & passes(found, z.shape[1], problem.doubted)

        best = self._descend(objective, problem, np.repeat(x0[None], trials, axis=0), history)
        confirmed = np.where(fits(best, np.arange(trials)), 0, -1)
        for k in range(self.starts - 1):
            affordable = tally.cost(len(x0)) < (np.inf if self.budget is None else self.budget)
            hopeless = ~finite(z) | tally.failed(np.arange(trials))
            rows = np.flatnonzero((confirmed < self.confirmations) & affordable & ~hopeless)
            if not len(rows):
                break
            x = x0 + spread_of_starts(problem) * draws[rows, k]
            again = self._descend(objective.subset(rows), problem, x, history)
            confirmed[rows] += (confirmed[rows] >= 0) | fits(again, rows)
            best = best.replaced(rows, again, again.better_than(take(best, rows)))
        return fitting.report(best.estimates(tally, z.shape[1]))

    def _descend(self, objective: Objective, problem: Problem, x: Array, history: bool) -> Minima:
        method = LevenbergMarquardtMethod(self.damping, problem.prior_used())
        return minimize(objective, method, x, Limits(self.tolerance, self.max_iterations, self.budget, history))
