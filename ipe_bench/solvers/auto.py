"""The estimator for people who do not want to choose: the cheapest way first, a judge, and more where it says no."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Lt
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Ended, Solver, Standing, iterate
from ipe_bench.estimators.fitting import Fitting, spread_of_starts
from ipe_bench.estimators.ipe import begin
from ipe_bench.estimators.least_squares import Descent, Minima, Objective, minimize, reached, squared
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.counted import Counted, Tally
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.fixed_point import FixedPoint
from ipe_bench.solvers.progressive import Progressive

_ITERATIONS = 12
"""Steps of fixed-point iteration that are tried; where more are needed, another way is cheaper."""
_NEAR = 1e-2
"""How near to its root, in deviations, fixed-point iteration brings a trial before the search goes on from there."""
_CHORDS = 8
_JACOBIANS = 3
_BENT = 100
"""Times the tolerance: the part of a chord step that the next one may take back. The answer is then about as many
deviations off. Steps of fewer deviations than this say nothing of how J changes."""
_UNSETTLED = Status.MAX_ITERATIONS
_CONFIRMATIONS = 4
_DAMPING, _STEPS = 1e-3, 100
"""Of a minimisation that looks for another minimum: lambda at its start, and steps tried."""

FIXED_POINT, PROGRESSIVE = 1, 2
"""The stages, as extras `stage` names them."""


@dataclass(frozen=True)
class Auto(Estimator):
    """The least-squares estimate, as cheaply as this problem allows.

    First the paper's fixed-point iteration, with H frozen at the nominal point, then Gauss-Newton steps with one
    Jacobian, that of the root which it has found: near to linear problems are solved so. A step of which the next one
    takes back more than a hundred tolerances says that J has changed; then it is computed anew. Where all that does not
    converge, or the residuals fail the test of the fit, `progressive`. Extras `stage` says which of the two answered, 1
    or 2. Cheapest first with a judge is how algorithm portfolios go (Gomes and Selman, Artificial Intelligence 126,
    2001); these stages and their judge, the calibrated test of the fit, are ours.

    Where the first stage did not suffice, `confirmations` minimisations from draws of the prior look for other minima
    that fit. Of several the one counts that is the most probable with the prior, since no residual can tell. Extras:
    `minima`, how many distinct minima that fit were found, and `ambiguous`, 1 where there are several, 0 where the look
    found none, which is no proof that there is none, and NaN where nobody looked; `alternatives` lists the others.

    One Jacobian of the first stage is the covariance's, and as with every solver not counted where it ends there.
    """

    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step still to go, in standard deviations of the local bound."""
    fit_level: Annotated[float, Ge(0), Lt(1)] = 1e-6
    """Residuals less probable than this are taken for those of a wrong minimum."""
    confirmations: Whole | None = None
    """Minimisations that look for other minima that fit, where the first stage did not suffice; None: four where a
    prior says where to look and no differential equations make each of them dear, else none."""
    seed: Whole = 0
    """A trial's random stream depends on this and on its readings: on nothing else in the batch."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        best, tally = self._quick(problem, z, history)
        answered = best.converged & (best.fit_probability(z.shape[1]) >= self.fit_level)
        tally = Tally(tally.simulations, tally.jacobians - answered, np.zeros(len(z), dtype=bool))
        left = np.flatnonzero(~answered)
        if len(left):
            thorough = Progressive(tolerance=self.tolerance, fit_level=self.fit_level, budget=self.budget)
            found, spent = thorough.search(problem, z[left], history=history)
            best = put(best, left, found)
            tally.simulations[left] += spent.simulations
            tally.jacobians[left] += spent.jacobians
            tally.messages.update({int(left[i]): message for i, message in spent.messages.items()})
        fitting = Fitting.none(len(z), z.shape[1], self.fit_level)
        fits = fitting.note(best, np.arange(len(z)))
        examined = left[fits[left]] if self._confirmations(problem) else left[:0]
        best = self._confirmed(problem, z, best, tally, fitting, examined, history)
        estimates = fitting.report(best.estimates(tally, z.shape[1]))
        nobody_looked = ~np.isin(np.arange(len(z)), examined)
        estimates.extras["ambiguous"][nobody_looked] = np.nan
        estimates.extras["stage"] = np.where(answered, FIXED_POINT, PROGRESSIVE).astype(float)
        return estimates

    def _confirmed(
        self,
        problem: Problem,
        z: Array,
        best: Minima,
        tally: Tally,
        fitting: Fitting,
        rows: NDArray[np.intp],
        history: bool,
    ) -> Minima:
        """The answers, after a look for others in the trials `rows`."""
        count, n = self._confirmations(problem), len(problem.x0)
        if not len(rows):
            return best
        draws = normals(own_generators(self.seed, z[rows]), count, n)
        whole = Objective(Counted(problem.measurement, tally), problem.R, z[rows], rows, problem.x0)
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

    def _quick(self, problem: Problem, z: Array, history: bool) -> tuple[Minima, Tally]:
        """Fixed-point iteration, then chord steps; trials that do not arrive have not converged."""
        minima = _nowhere(problem, len(z), history)
        try:
            x, system = begin(problem, z, "linear_lse")
        except UserError:  # H lacks rank at the nominal point, which says nothing of other points
            return minima, Tally.zeros(len(z))
        limits = {"tolerance": _NEAR, "max_iterations": _ITERATIONS, "budget": self.budget}
        ended = iterate(system, FixedPoint(), x, history=history, **limits)
        tally = system.model.tally
        near = np.flatnonzero(ended.converged)
        if len(near):
            whole = Objective(Counted(problem.measurement, tally), problem.R, z, np.arange(len(z)), problem.x0)
            minima = put(minima, near, self._chords(whole, near, take(ended, near), history))
        return minima, tally

    def _chords(self, whole: Objective, rows: NDArray[np.intp], before: Ended[Any], history: bool) -> Minima:
        """Chord steps for the trials `rows`, each time with a new Jacobian until it is that of the end."""
        limits = {"tolerance": self.tolerance, "max_iterations": _CHORDS, "budget": self.budget}
        result, at, start = None, np.arange(len(rows)), before
        for _ in range(_JACOBIANS):
            objective = whole.subset(rows[at])
            ended = iterate(objective, _Chord(_BENT * self.tolerance), start.x, history=history, **limits)
            bent = ended.converged & (ended.state.bend > _BENT * self.tolerance)
            minima = reached(objective, ended)
            minima = _after(start, replace(minima, status=np.where(bent, _UNSETTLED, minima.status).astype(np.int8)))
            result = minima if result is None else put(result, at, minima)
            at, start = at[bent], take(minima, bent)
            if not len(at):
                break
        assert result is not None
        return result


def _improbability(problem: Problem, minima: Minima) -> Array:
    """Minus twice the logarithm (trials,) of the posterior density, or of the likelihood without a prior, but for a
    constant."""
    prior = problem.prior_covariance()
    if prior is None:
        return minima.chi_square
    return minima.chi_square + np.sum(prior.whiten(minima.x - problem.x0) ** 2, axis=1)


def _after(first: Ended[Any] | Minima, second: Minima) -> Minima:
    """The second of two iterations, with the iterations and iterates of both."""
    history = second.history
    if first.history is not None and history is not None:
        history = [np.concatenate([a, b[1:]]) for a, b in zip(first.history, history, strict=True)]
    return replace(second, iterations=first.iterations + second.iterations, history=history)


@dataclass(frozen=True)
class _OnChords(Descent):
    """`Descent` by chords."""

    bend: Array = field(default_factory=lambda: np.zeros(0))
    """The largest part (trials,) of a step that the next one had to take back: how far J has changed on the way."""


@dataclass(frozen=True)
class _Chord(Solver[_OnChords]):
    """Gauss-Newton steps with the Jacobian of the start, which is near enough to the end for it."""

    visible: float
    """Steps of fewer deviations are not judged by."""

    def begin(self, objective: Objective, x: Array) -> _OnChords:
        state = Descent.at(objective, x, keep_Q=True)
        return _OnChords(**vars(state), bend=np.zeros(len(x)))

    def step(self, objective: Objective, state: _OnChords) -> _OnChords:
        x = state.x + state.slope.newton
        r = objective.residual(x)
        slope = state.slope.towards(r)
        bend = np.where(state.slope.size > self.visible, slope.size / state.slope.size, 0.0)
        moved = state.reach(state.slope.newton)
        return replace(state, x=x, r=r, cost=squared(r), slope=slope, moved=moved, bend=np.fmax(state.bend, bend))

    def standing(self, objective: Objective, before: Descent | None, state: Descent) -> Standing:
        return state.standing(objective, stuck=state.rankless)


def _nowhere(problem: Problem, trials: int, history: bool) -> Minima:
    """No answer for any trial."""
    n = problem.measurement.n
    far = np.full(trials, np.inf)
    return Minima(
        np.repeat(problem.x0[None], trials, axis=0),
        np.full(trials, Status.MAX_ITERATIONS, np.int8),
        np.zeros(trials, np.int64),
        [problem.x0[None]] * trials if history else None,
        np.full((trials, n, n), np.nan),
        far,
        far,
    )
