"""The estimator for people who do not want to choose: the cheapest way first, a judge, and more where it says no."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Lt
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Solver, Standing, iterate
from ipe_bench.estimators.ipe import begin
from ipe_bench.estimators.least_squares import Descent, Minima, Objective, minimize, squared
from ipe_bench.measurements.counted import Counted, Tally
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.fixed_point import FixedPoint
from ipe_bench.solvers.progressive import Progressive

_ITERATIONS = 12
"""Steps of fixed-point iteration that are tried; where more are needed, another way is cheaper."""
_NEAR = 1e-2
"""How near to its root, in deviations, fixed-point iteration brings a trial before the search goes on from there."""
_CHORDS = 8

FIXED_POINT, PROGRESSIVE = 1, 2
"""The stages, as extras `stage` names them."""


@dataclass(frozen=True)
class Auto(Estimator):
    """The least-squares estimate, as cheaply as this problem allows.

    First the paper's fixed-point iteration, with H frozen at the nominal point, then Gauss-Newton steps with one
    Jacobian, that of the root which it has found: near to linear problems are solved so. Where that does not converge,
    or the residuals fail the test of the fit, `progressive`. Extras `stage` says which of the two answered, 1 or 2.

    The one Jacobian of the first stage is the covariance's, and as with every solver not counted where it ends there.
    """

    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step still to go, in standard deviations of the local bound."""
    fit_level: Annotated[float, Ge(0), Lt(1)] = 1e-6
    """Residuals less probable than this are taken for those of a wrong minimum."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        quick, tally = self._quick(problem, z, history)
        answered = quick.converged & (quick.fit_probability(z.shape[1]) >= self.fit_level)
        tally.jacobians[answered] = 0.0
        extras = {"stage": np.where(answered, FIXED_POINT, PROGRESSIVE).astype(float)}
        first = replace(quick.estimates(tally, z.shape[1]), messages={})
        if answered.all():
            return replace(first, extras=first.extras | extras)
        left = np.flatnonzero(~answered)
        thorough = Progressive(tolerance=self.tolerance, fit_level=self.fit_level, budget=self.budget)
        rest = thorough.estimate(problem, z[left], history=history)
        rest = replace(
            rest,
            simulations=rest.simulations + tally.simulations[left],
            jacobians=rest.jacobians + tally.jacobians[left],
        )
        return _merged(first, left, rest, extras)

    def _quick(self, problem: Problem, z: Array, history: bool) -> tuple[Minima, Tally]:
        """Fixed-point iteration, then chord steps; trials that do not arrive have not converged."""
        try:
            x, system = begin(problem, z, "linear_lse")
        except UserError:  # H lacks rank at the nominal point, which says nothing of other points
            return _nowhere(problem, len(z), history), Tally.zeros(len(z))
        limits = {"tolerance": _NEAR, "max_iterations": _ITERATIONS, "budget": self.budget}
        ended = iterate(system, FixedPoint(), x, history=history, **limits)
        tally = system.model.tally
        near, minima = np.flatnonzero(ended.converged), _nowhere(problem, len(z), history)
        if not len(near):
            return minima, tally
        counted = Tally(tally.simulations[near], tally.jacobians[near], np.zeros(len(near), dtype=bool))
        model = Counted(problem.measurement, counted)
        objective = Objective(model, problem.R, z[near], np.arange(len(near)), problem.x0)
        arrived = minimize(
            objective,
            _Chord(),
            ended.x[near],
            tolerance=self.tolerance,
            max_iterations=_CHORDS,
            budget=self.budget,
            history=history,
        )
        paths = take(ended, near).history
        if paths is not None and arrived.history is not None:
            paths = [np.concatenate([a, b[1:]]) for a, b in zip(paths, arrived.history, strict=True)]
        arrived = replace(arrived, iterations=arrived.iterations + ended.iterations[near], history=paths)
        tally.simulations[near], tally.jacobians[near] = counted.simulations, counted.jacobians
        return put(minima, near, arrived), tally


@dataclass(frozen=True)
class _Chord(Solver[Descent]):
    """Gauss-Newton steps with the Jacobian of the start, which is near enough to the end for it."""

    def begin(self, objective: Objective, x: Array) -> Descent:
        return Descent.at(objective, x, keep_Q=True)

    def step(self, objective: Objective, state: Descent) -> Descent:
        x = state.x + state.slope.newton
        r = objective.residual(x)
        slope = state.slope.towards(r)
        return replace(state, x=x, r=r, cost=squared(r), slope=slope, moved=state.reach(state.slope.newton))

    def standing(self, objective: Objective, before: Descent | None, state: Descent) -> Standing:
        return state.standing(stuck=state.rankless)


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


def _merged(first: Estimates, left: NDArray[np.intp], rest: Estimates, extras: dict[str, Array]) -> Estimates:
    """The estimates of the first stage, but for the trials that were left to the second."""
    assert first.covariance is not None
    assert rest.covariance is not None
    history = None
    if first.history is not None and rest.history is not None:
        history = put(first.history, left, rest.history)  # type: ignore[type-var]
    return Estimates(
        x=put(first.x, left, rest.x),
        status=put(first.status, left, rest.status),
        covariance=put(first.covariance, left, rest.covariance),
        iterations=put(first.iterations, left, rest.iterations),
        simulations=put(first.simulations, left, rest.simulations),
        jacobians=put(first.jacobians, left, rest.jacobians),
        messages={int(left[i]): message for i, message in rest.messages.items()},
        history=history,
        extras={name: put(values, left, rest.extras[name]) for name, values in first.extras.items()} | extras,
    )
