"""The estimator for people who do not want to choose: the cheapest way first, a judge, and more where it says no."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Lt
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive, Whole
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.fitting import Fitting, spread_of_starts
from ipe_bench.estimators.least_squares import Minima, Objective, minimize
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.chords import Chords
from ipe_bench.solvers.progressive import Progressive, accepted

_CONFIRMATIONS = 4
_DAMPING, _STEPS = 1e-3, 100
"""Of a minimisation that looks for another minimum: lambda at its start, and steps tried."""

CHORDS, PROGRESSIVE = 1, 2
"""The stages, as extras `stage` names them."""


@dataclass(frozen=True)
class Auto(Estimator):
    """The least-squares estimate, as cheaply as this problem allows.

    First the paper's fixed-point iteration, with H frozen at the nominal point and Anderson's acceleration, given up
    where it does not come nearer to a root; then Gauss-Newton steps with one Jacobian, that of the root which it has
    found, computed anew as long as its change would leave the answer more than some hundred tolerances from the
    minimum: near to linear problems are solved so. Where all that does not converge, or the residuals fail the test of
    the fit, `progressive`, which knows what was found. Extras `stage` says which of the two answered, 1 or 2. Cheapest
    first with a judge is how algorithm portfolios go (Gomes and Selman, Artificial Intelligence 126, 2001); these
    stages and their judge, the calibrated test of the fit, are ours.

    Where the first stage did not suffice, or plain fixed-point iteration would hardly contract at its answer, eq. (18),
    `confirmations` minimisations from draws of the prior look for other minima that fit. Of several the one counts that
    is the most probable with the prior, since no residual can tell. Extras: `minima`, how many distinct minima that fit
    were found, and `ambiguous`, 1 where there are several, 0 where the look found none, which is no proof that there is
    none, and NaN where nobody looked; `alternatives` lists the others.

    One Jacobian of the first stage is the covariance's, and as with every solver not counted where it ends there.
    """

    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step still to go, in standard deviations of the local bound."""
    fit_level: Annotated[float, Ge(0), Lt(1)] = 1e-6
    """Residuals less probable than this are taken for those of a wrong minimum."""
    confirmations: Whole | None = None
    """Minimisations that look for other minima that fit, where the problem is far from linear; None: four where a prior
    says where to look and no differential equations make each of them dear, else none."""
    seed: Whole = 0
    """A trial's random stream depends on this and on its readings: on nothing else in the batch."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z, prior=False)
        tally = objective.model.tally
        best, contracts = Chords(objective, problem.H, self.tolerance, self.budget, history).minima()
        fitting = Fitting.none(len(z), z.shape[1], self.fit_level)
        fits = fitting.note(best, np.arange(len(z)))
        answered = accepted(best, z.shape[1], max(self.fit_level, problem.doubted))
        tally = EvaluationCount(tally.simulations, tally.jacobians - answered, np.zeros(len(z), dtype=bool))
        left = np.flatnonzero(~answered)
        if len(left):
            thorough = Progressive(tolerance=self.tolerance, fit_level=self.fit_level, budget=self.budget)
            found, spent = thorough.search(problem, z[left], before=take(best, left), history=history)
            best = put(best, left, found)
            tally.simulations[left] += spent.simulations
            tally.jacobians[left] += spent.jacobians
            tally.messages.update({int(left[i]): message for i, message in spent.messages.items()})
        fits[left] = fitting.note(take(best, left), left)
        examined = np.flatnonzero(fits & ~(answered & contracts)) if self._confirmations(problem) else left[:0]
        best = self._confirmed(problem, z, best, tally, fitting, examined, history)
        estimates = fitting.report(best.estimates(tally, z.shape[1]))
        nobody_looked = ~np.isin(np.arange(len(z)), examined)
        estimates.extras["ambiguous"][nobody_looked] = np.nan
        estimates.extras["stage"] = np.where(answered, CHORDS, PROGRESSIVE).astype(float)
        return estimates

    def _confirmed(
        self,
        problem: Problem,
        z: Array,
        best: Minima,
        tally: EvaluationCount,
        fitting: Fitting,
        rows: NDArray[np.intp],
        history: bool,
    ) -> Minima:
        """The answers, after a look for others in the trials `rows`."""
        count, n = self._confirmations(problem), len(problem.x0)
        if not len(rows):
            return best
        draws = normals(own_generators(self.seed, z[rows]), count, n)
        whole = Objective(CountingModel(problem.measurement, tally), problem.R, z[rows], rows, problem.x0)
        method = LevenbergMarquardtMethod(_DAMPING, problem.prior_used())
        limits = {"tolerance": self.tolerance, "max_iterations": _STEPS, "budget": self.budget}
        for k in range(count):
            x = problem.x0 + spread_of_starts(problem) * draws[:, k]
            again = minimize(whole, method, x, history=history, **limits)
            known = take(best, rows)
            better = fitting.note(again, rows) & (_improbability(problem, again) < _improbability(problem, known))
            spent = best.iterations.copy()
            spent[rows] += again.iterations
            best = replace(put(best, rows[better], take(again, better)), iterations=spent)
        return best

    def _confirmations(self, problem: Problem) -> int:
        if self.confirmations is not None:
            return self.confirmations
        dear = problem.measurement.by_differential_equations
        return 0 if dear or problem.prior_deviation is None else _CONFIRMATIONS


def _improbability(problem: Problem, minima: Minima) -> Array:
    """Minus twice the logarithm (trials,) of the posterior density, or of the likelihood without a prior, but for a
    constant."""
    prior = problem.prior_covariance()
    if prior is None:
        return minima.chi_square
    return minima.chi_square + np.sum(prior.whiten(minima.x - problem.x0) ** 2, axis=1)
