"""Progressive IPE: the least-squares estimate, reached from far away by windows that grow as a filter sees the data.

What an attempt is, is left to `windows` where readings arrive in epochs, and to `stages` where their order says
nothing; here is the judge, and when to stop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Lt

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite
from ipe_bench.basics.options import Count, Positive, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.least_squares import Minima
from ipe_bench.measurements.counted import Tally
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.stages import Stages
from ipe_bench.solvers.windows import GIVEN_UP, Windows

_SAME_FIT = 1e-6
"""Two minima whose chi-squares differ by less than this share are one."""
_BULK = 1.0
"""Where half of the residuals are within so many deviations, for .67 where all is right, and there are at least"""
_READINGS = 4
"""so many readings for each parameter, the minimum is right and it is R that is wrong for a few of them."""


@dataclass(frozen=True)
class Progressive(Estimator):
    """The least-squares estimate, reached from far away.

    A short stretch of data is nearly linear in the parameters, so its fit is easy to find; it starts the fit of a
    window `growth` times as long, and so on to all data. In the windows the prior counts, as it does for a filter, and
    damps in its own metric, lambda |dx / prior_deviation|^2; Marquardt's scaling fails there, since an early window
    leaves some parameters nearly free. The last pass, on all data, is plain least squares without the prior.

    The test of the residuals is the estimator's own verdict, extras `fit_p`. A trial that fails it, and whose bulk of
    residuals is large too, is tried again: carefully from the nominal point (windows that grow slowly, damping by the
    residual, steps bent along the curvature), then from 16, 32, ... draws of the prior, which the first windows keep
    apart and the later ones thin out to those that fit best. An attempt that leads to the same minimum again ends the
    search, unless its residuals are beyond any use; the best fit counts.

    Growing windows that start one another are the incremental single shooting of Michalik, Hannemann and Marquardt
    (Comput. Chem. Eng. 33, 2009) and, with a prior, the recursive iterative batch smoother of Stepanov et al. (Sensors
    25, 2025). Many draws carried through growing data and thinned out on the way are data-tempered Monte Carlo (Chopin,
    Biometrika 89, 2002), with minimisations for its moves; draws whose priors are centred at themselves are the
    randomised maximum likelihood of Oliver, He and Reynolds (1996). The damping in the prior's metric, the calibrated
    test of the fit as the judge, and the order of cheap and dear attempts are ours.
    """

    growth: Annotated[float, Gt(1)] = 2.0
    """Each window has about this many times the epochs of the one before; the first has one epoch."""
    use_prior: bool = True
    prior_inflation: Positive = 1.0
    """Times the prior's standard deviations."""
    damping: Positive = 1.0
    """lambda at the start of every window."""
    window_tolerance: Positive = 0.1
    """Where a window's fit is good enough: the Gauss-Newton step in standard deviations."""
    window_iterations: Count = 10
    """Of the first attempt."""
    max_iterations: Count = 60
    """Steps of the last pass."""
    tolerance: Positive = 1e-6
    """Of the last pass: the Gauss-Newton step in standard deviations of the local bound."""
    restarts: Whole | None = None
    """Further attempts at a trial that fails the test; None: six with windows, eleven without."""
    fit_level: Annotated[float, Ge(0), Lt(1)] = 1e-6
    """Residuals less probable than this are taken for those of a wrong minimum."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n and a window its share; None: no limit."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        best, tally = self.search(problem, z, history=history)
        return best.estimates(tally, z.shape[1])

    def search(
        self, problem: Problem, z: Array, *, before: Minima | None = None, history: bool = False
    ) -> tuple[Minima, Tally]:
        """The best minimum of each trial, and what it has cost to find it. `before`: what is known already, minima
        that do not fit, or none; where one of them is found again the search ends, as with its own."""
        kind = Stages if problem.measurement.epochs is None else Windows
        search = kind(self, problem, z, Tally.zeros(len(z)), history)
        best = search.attempt(0, np.arange(len(z)), None)
        repeated = np.zeros(len(z), dtype=np.int64)
        if before is not None:
            repeated += _found_again(best, before, z.shape[1])
            worse = before.converged & ~_is_better(best, before)
            best = put(best, worse, take(before, worse))
        for k in range(1, search.last + 1):
            suspect = np.flatnonzero(self._suspect(problem, best, search.tally, z) & (repeated < kind.enough))
            if not len(suspect):
                break
            known = take(best, suspect)
            again = search.attempt(k, suspect, known)
            repeated[suspect] += _found_again(again, known, z.shape[1])
            better = _is_better(again, known)
            best = put(best, suspect[better], take(again, better))
        raised = search.tally.failed(np.arange(len(z))) & ~best.converged
        return replace(best, status=np.where(raised, Status.ERROR, best.status).astype(np.int8)), search.tally

    def _suspect(self, problem: Problem, best: Minima, tally: Tally, z: Array) -> Mask:
        """The trials that another attempt may help: (trials,)."""
        hopeless = ~finite(z) | tally.failed(np.arange(len(z)))
        affordable = tally.cost(best.x.shape[1]) < (np.inf if self.budget is None else self.budget)
        return ~accepted(best, z.shape[1], self.fit_level) & ~hopeless & affordable


def accepted(minima: Minima, readings: int, level: float) -> Mask:
    """Which minima (trials,) are taken for the least: those that fit, and those whose bulk of residuals does."""
    gross_errors_only = (minima.bulk <= _BULK) & (readings >= _READINGS * minima.x.shape[1])
    return minima.converged & ((minima.fit_probability(readings) >= level) | gross_errors_only)


def _found_again(new: Minima, old: Minima, readings: int) -> Mask:
    """Where an attempt led to the known minimum, and that may be the least one of a model that does not quite hold."""
    with np.errstate(invalid="ignore"):  # two infinite fits are not one minimum
        same = np.abs(new.chi_square - old.chi_square) <= _SAME_FIT * np.maximum(new.chi_square, old.chi_square)
    return new.converged & old.converged & same & (new.chi_square <= GIVEN_UP * readings)


def _is_better(new: Minima, old: Minima) -> Mask:
    """Where a new attempt counts rather than the old one: it converged and fits better, or the old one had no end."""
    fits_better = ~(new.chi_square >= old.chi_square)
    return new.converged & (fits_better | ~old.converged)
