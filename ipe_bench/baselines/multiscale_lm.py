"""Levenberg-Marquardt under two scalings of the parameters, of which the better minimum counts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Minima, Objective, minimize
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class MultiscaleLM(Estimator):
    """Least squares for hard starts: minimised twice from the nominal point, and the lower minimum kept.

    Damping pulls a step towards short ones, and what is short depends on the scaling. Marquardt's (column norms of J,
    growing) does not care for units but may run along a parameter that the readings hardly see at the start; parameters
    in multiples of their size, which a model states for this very purpose, do not, but they bend the path where a
    parameter ends far from its size. The two fail in different places. Steps by QR, to a tolerance near round-off.
    Costs about twice as much as one Levenberg-Marquardt.
    """

    max_iterations: Count = 1000
    """Of each of the two minimisations."""
    tolerance: Positive = 1e-10
    """Largest Gauss-Newton step in standard deviations of the local bound."""
    damping: Positive = 1e-4
    """The first damping factor, relative to the squared norm of J."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z, prior=False)
        size = np.full(len(problem.x0), 1.0 / np.linalg.norm(problem.R.whiten_jacobian(problem.H)))
        by_size, by_columns = (
            minimize(
                objective,
                LevenbergMarquardtMethod(self.damping, metric),
                np.repeat(problem.x0[None], len(z), axis=0),
                Limits(self.tolerance, self.max_iterations, history=history),
            )
            for metric in (size, None)
        )
        return _better(by_size, by_columns).estimates(objective.model.tally, z.shape[1])


def _better(first: Minima, second: Minima) -> Minima:
    """For each trial the minimum that fits better; the first where they fit alike to round-off."""
    costs = [np.where(np.isfinite(m.chi_square), m.chi_square, np.inf) for m in (first, second)]
    # Without a finite fit anywhere the first keeps its status.
    improves = costs[1] < costs[0] * (1 - 1e-12)
    best = put(first, improves, take(second, improves))
    return replace(best, iterations=first.iterations + second.iterations)
