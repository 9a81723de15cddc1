"""Implements progressive IPE: the least-squares estimate, reached from far away by windows that
grow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Gt

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite
from ipe_bench.basics.options import Count, Positive, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.minima import WRONG_MINIMUM, Minima, passes
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.starts import Starts
from ipe_bench.solvers.windows import Windows

# Halved or doubled, each leaves 155 of 160 trials solved, or one more with `_READINGS` doubled, and
# the cost within 2 %: `python tests/benchmarks/constants.py progressive`.
_SAME_FIT = 1e-6
"""Two minima whose chi-squares differ by less than this share are one."""
_BULK = 1.0
"""The median residual in deviations, .67 where all is right, up to which the minimum is right and R
wrong for a few."""
_READINGS = 4
"""The least number of readings per parameter for which the median says so."""
_TRUSTED = 1e-3
"""A significance of the test of fit from which on a large bulk of residuals is asked for no longer:
R is known, or unknown."""
_WORTH = 20.0
"""The most that a search for a better fit may cost, in costs of the first fit."""


@dataclass(frozen=True)
class Progressive(Estimator):
    """Finds the least-squares estimate from far away.

    A short stretch of data is nearly linear in the parameters, so its fit is easy to find; it
    starts the fit of a window `growth` times as long, and so on to all data. In the windows the
    prior counts, as it does for a filter, and damps in its own metric, lambda |dx /
    prior_deviation|^2. The last pass, on all data, is plain least squares.

    The test of the residuals is the estimator's own verdict, extras `fit_p`. A trial that fails it,
    and whose bulk of residuals is large too, is tried again: carefully from the start
    (windows that grow slowly, damping by the residual, steps bent along the curvature), by
    Levenberg-Marquardt on all data, and from 16, 32, ... draws of the prior, which the first
    windows keep apart and the later ones thin out to those that fit best. The best fit counts. A
    minimum that other attempts lead to again, some from independent draws, ends the search; so does
    20 times the cost of the first fit, once draws were tried. The message of such a trial says how
    far the search went.

    Sources: the incremental single shooting of Michalik, Hannemann and Marquardt (Comput. Chem.
    Eng. 33, 2009); with a prior, the recursive iterative batch smoother of Stepanov et al. (Sensors
    25, 2025); data-tempered Monte Carlo (Chopin, Biometrika 89, 2002), with minimisations for its
    moves.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"progressive": ib.solvers.Progressive(growth=3.0)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    growth: Annotated[float, Gt(1)] = 2.0
    """Each window has about this many times the epochs of the one before; the first has one
    epoch."""
    use_prior: bool = True
    prior_inflation: Positive = 1.0
    """Times the prior's standard deviations."""
    window_tolerance: Positive = 0.1
    """The Gauss-Newton step, in standard deviations, at which a window's fit is good enough."""
    max_iterations: Count = 60
    """Steps of the last pass."""
    tolerance: Positive = 1e-6
    """The Gauss-Newton step, in standard deviations of the local bound, that ends the last pass."""
    restarts: Whole | None = None
    """Further attempts at a trial that fails the test; None: eight with windows, fifteen
    without."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n and a window its share; None: no
    limit."""

    equation = "least_squares"
    family = "IPE"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        best, tally = self.search(problem, z, history=history)
        return best.estimates(tally, z.shape[1])

    def search(
        self, problem: Problem, z: Array, *, before: Minima | None = None, history: bool = False
    ) -> tuple[Minima, EvaluationCount]:
        """Finds the best minimum of each trial and the cost of finding it. `before`: minima that
        are known already and do not fit."""
        everyone = np.arange(len(z))
        n = len(problem.x0)
        m = z.shape[1]
        attempts = self._attempts(problem, z, history)
        tally = attempts.tally
        significance = max(WRONG_MINIMUM, problem.doubted)
        best = attempts.attempt(0, everyone, None)
        if before is not None:
            worse = before.converged & ~best.better_than(before)
            best = put(best, worse, take(before, worse))
        # Of each trial: attempts after the first, independent draws among their starts, attempts
        # that led to the best minimum again, those of them from draws, the cost of the first fit.
        tried, drawn, repeats, independent = np.zeros((4, len(z)), np.int64)
        first = np.full(len(z), np.inf)
        budget = np.inf if self.budget is None else self.budget
        for k in range(1, attempts.last + 1):
            cost = tally.of_search(n)
            first = np.where(best.converged, np.minimum(first, cost), np.inf)
            failing = ~accepted(best, m, significance) & finite(z) & ~tally.failed(everyone)
            # Neither the cost nor repeats end a search before draws were tried.
            most = np.minimum(_WORTH * first, attempts.most * (1 + n))
            worth = (cost < most) | (drawn == 0)
            unsettled = (repeats < attempts.repeats) | (independent == 0)
            rows = np.flatnonzero(failing & worth & unsettled & (cost < budget))
            if not len(rows):
                break
            known = take(best, rows)
            again = attempts.attempt(k, rows, known)
            better = again.better_than(known)
            same = _same(again, known)
            draws = attempts.draws(k)
            tried[rows] += 1
            drawn[rows] += draws
            # A better minimum that is another one has been found once.
            other = better & ~same
            repeats[rows] = np.where(other, 0, repeats[rows] + same)
            independent[rows] = np.where(other, 0, independent[rows] + (same & (draws > 0)))
            best = put(best, rows[better], take(again, better))
        raised = tally.failed(everyone) & ~best.converged
        doubtful = best.converged & ~accepted(best, m, significance) & (tried > 0)
        for i in np.flatnonzero(doubtful).tolist():
            tally.messages[i] = _words(tried[i], drawn[i], repeats[i])
        status = np.where(raised, Status.ERROR, best.status)
        return replace(best, status=status.astype(np.int8)), tally

    def _attempts(self, problem: Problem, z: Array, history: bool) -> Starts | Windows:
        kind = Starts if problem.measurement.epochs is None else Windows
        prior = problem.prior_used(self.prior_inflation) if self.use_prior else None
        limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
        return kind(
            problem,
            prior,
            z,
            EvaluationCount.zeros(len(z)),
            limits,
            self.growth,
            self.window_tolerance,
            self.restarts,
        )


def _same(one: Minima, other: Minima) -> Mask:
    """Tells where two minima (trials,) are one."""
    # Two infinite fits are not one minimum.
    with np.errstate(invalid="ignore"):
        near = _SAME_FIT * np.maximum(one.chi_square, other.chi_square)
        alike = np.abs(one.chi_square - other.chi_square) <= near
    return one.converged & other.converged & alike


def _words(tried: int, drawn: int, repeats: int) -> str:
    """Says how far the search went in a trial."""
    count = "1 more attempt" if tried == 1 else f"{tried} more attempts"
    draws = f" from {drawn} independent draws" if drawn else ""
    led = f"{repeats} led to this minimum again" if repeats else "none found one"
    return f"{count}{draws} looked for a better fit; {led}"


def accepted(minima: Minima, readings: int, significance: float) -> Mask:
    """Tells which minima (trials,) are taken for the least: those that fit, and those whose bulk of
    residuals does."""
    gross_errors_only = (minima.bulk <= _BULK) & (readings >= _READINGS * minima.x.shape[1])
    fits = passes(minima, readings, significance)
    return minima.converged & (fits | (gross_errors_only & (significance < _TRUSTED)))
