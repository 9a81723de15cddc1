"""Combines a portfolio: chord iterations first; the progressive method where the fit test rejects
their answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive, Whole
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import WRONG_MINIMUM, Fitting, Minima, minimize, spread_of_starts
from ipe_bench.measurements.counted import CountingModel
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.chords import by_chords
from ipe_bench.solvers.progressive import Progressive, accepted

_CONFIRMATIONS = 4
_WORTH = 3.0
_LED = 2
"""These looks end at this many times the cost of the first fit, once so many of them have led to
minima that were known: the median cost on ranging at error scale 100 falls from 284 to 151, and
auto still flags 33 of its 39 failures on triads (34 with all looks; 26 if the cost alone ends them,
28 after one that led to a known minimum). `python tests/benchmarks/reach.py` has the table."""
_DAMPING = 1e-3
"""lambda at the start of a minimisation that looks for another minimum."""
_STEPS = 100
"""Steps of such a minimisation, tried or taken."""

CHORDS = 1
PROGRESSIVE = 2
"""The stages, as extras `stage` names them."""


@dataclass(frozen=True)
class Auto(Estimator):
    """Finds the least-squares estimate, as cheaply as this problem allows.

    First the paper's fixed-point iteration, with H frozen at the start and Anderson's
    acceleration, given up where it does not come nearer to a root; then Gauss-Newton steps with one
    Jacobian, that of the root which it has found, computed anew as long as its change would leave
    the answer more than some hundred tolerances from the minimum. Where that does not converge, or
    the residuals fail the test of the fit, `progressive`, which knows what was found. Extras
    `stage` says which of the two answered, 1 or 2. Such portfolios of algorithms are described by
    Gomes and Selman (Artificial Intelligence 126, 2001).

    Where the first stage did not suffice, or plain fixed-point iteration would hardly contract at
    its answer, eq. (18), `confirmations` minimisations from draws of the prior look for other
    minima that fit, of which the one counts that is the most probable with the prior. Extras:
    `minima`, how many distinct minima that fit were found, and `ambiguous`, 1 where there are
    several, 0 where the look found none, and NaN if no look was taken; `alternatives` lists the
    others.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"auto": ib.solvers.Auto()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step still to go, in standard deviations of the local bound."""
    confirmations: Whole | None = None
    """Minimisations that look for other minima that fit, where the problem is far from linear;
    None: four where a prior says where to look and no differential equations make each of them
    dear, else none; fewer where two led to minima that were known, and they have cost three times
    the first fit."""
    seed: Whole = 0
    """Seed of a trial's random stream, which depends on this and on the trial's readings alone."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"
    family = "IPE"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        everyone = np.arange(len(z))
        m = z.shape[1]
        objective = Objective.of(problem, z)
        best, contracts = by_chords(
            objective, problem.H, self.tolerance, self.budget, history=history
        )
        fitting = Fitting.none(len(z), m)
        fits = fitting.note(best, everyone)
        answered = accepted(best, m, max(WRONG_MINIMUM, problem.doubted))
        tally = objective.model.tally.copied(everyone)
        left = np.flatnonzero(~answered)
        if len(left):
            thorough = Progressive(tolerance=self.tolerance, budget=self.budget)
            known = take(best, left)
            found, spent = thorough.search(problem, z[left], before=known, history=history)
            best = put(best, left, found)
            tally.simulations[left] += spent.simulations
            tally.jacobians[left] += spent.jacobians
            tally.reported[left] += spent.reported
            tally.messages.update({int(left[i]): message for i, message in spent.messages.items()})
        fits[left] = fitting.note(take(best, left), left)
        count = self.confirmations
        if count is None:
            dear = problem.measurement.by_differential_equations or problem.prior_deviation is None
            count = 0 if dear else _CONFIRMATIONS
        looked = fits & ~(answered & contracts) & (count > 0)
        if looked.any():
            rows = np.flatnonzero(looked)
            model = CountingModel(problem.measurement, tally)
            whole = Objective(model, problem.R, z[rows], rows, problem.x0)
            best = self._confirmed(problem, whole, best, fitting, count, history)
        estimates = fitting.report(best.estimates(tally, m))
        estimates.extras["ambiguous"][~looked] = np.nan
        estimates.extras["stage"] = np.where(answered, CHORDS, PROGRESSIVE).astype(float)
        return estimates

    def _confirmed(
        self,
        problem: Problem,
        objective: Objective,
        best: Minima,
        fitting: Fitting,
        count: int,
        history: bool,
    ) -> Minima:
        """Returns the answers, after `count` looks for others in the trials of the objective, or
        fewer where further ones are not worth it."""
        n = len(problem.x0)
        tally = objective.model.tally
        draws = normals(own_generators(self.seed, objective.z), count, n)
        method = LevenbergMarquardtMethod(_DAMPING, problem.prior_used())
        limits = Limits(self.tolerance, _STEPS, self.budget, history)
        most = np.full(len(best.x), np.inf)
        if self.confirmations is None:
            most = (1 + _WORTH) * tally.of_search(n)
        led = np.zeros(len(best.x), np.int64)
        for k in range(count):
            rows = objective.rows
            dear = tally.of_search(n)[rows] >= most[rows]
            going = ~(dear & (led[rows] >= _LED))
            objective = objective.subset(going)
            draws = draws[going]
            rows = rows[going]
            if not rows.size:
                break
            start = problem.x0 + spread_of_starts(problem) * draws[:, k]
            again = minimize(objective, method, start, limits)
            known = take(best, rows)
            likelier = _improbability(problem, again) < _improbability(problem, known)
            before = fitting.counts(rows)
            fits = fitting.note(again, rows)
            led[rows] += fits & (fitting.counts(rows) == before)
            best = best.replaced(rows, again, fits & likelier)
        return best


def _improbability(problem: Problem, minima: Minima) -> Array:
    """Computes minus twice the logarithm (trials,) of the posterior density, or of the likelihood
    without a prior, but for a constant."""
    prior = problem.prior_covariance()
    of_prior = 0.0
    if prior is not None:
        of_prior = np.sum(prior.whiten(minima.x - problem.x0) ** 2, axis=1)
    return minima.chi_square + of_prior
