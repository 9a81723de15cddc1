"""Roots of the estimating equations from given points: started at the truth, they tell a false root from the right one.

Nothing here is an estimator: an estimator does not know where to start.
"""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.ipe import FrozenSystem, Roots, find_roots, linear_deviation
from ipe_bench.least_squares import Damping, Minima, Objective, minimize
from ipe_bench.linalg import Array
from ipe_bench.scenario import Problem
from ipe_bench.solvers.base import Solver, State, System
from ipe_bench.solvers.newton import Newton
from ipe_bench.statuses import Status

_TOLERANCE = 1e-6
_CHORD_STEPS = 8


@dataclass(frozen=True)
class _ChordState(State):
    J: Array


@dataclass(frozen=True)
class _Chord(Solver):
    """x <- x - J(x_start)^-1 F(x): Newton's method with the first Jacobian kept."""

    def init(self, system: System, x: Array, F: Array) -> _ChordState:
        return _ChordState(x, F, system.J(x))

    def step(self, system: System, state: State) -> _ChordState:
        assert isinstance(state, _ChordState)
        x = state.x - system.solve(state.J, state.F)
        return _ChordState(x, system.F(x), state.J)


def frozen_root(problem: Problem, z: Array, x_start: Array) -> Roots:
    """The root of the frozen equation (11) next to x_start (trials, n), for readings z (trials, m).

    Chord steps with the Jacobian at x_start, which is enough where x_start is the truth; Newton's method for the trials
    where it is not.
    """
    system = FrozenSystem.at_nominal(problem, z)
    deviation = linear_deviation(system, problem)
    roots = find_roots(system, _Chord(), x_start, deviation, tolerance=_TOLERANCE, max_iterations=_CHORD_STEPS)
    rest = roots.status != Status.CONVERGED
    if rest.any():
        again = FrozenSystem.at_nominal(problem, z[rest])
        newton = find_roots(again, Newton(), x_start[rest], deviation, tolerance=_TOLERANCE, max_iterations=20)
        for name in ("x", "status", "iterations"):
            getattr(roots, name)[rest] = getattr(newton, name)
    return roots


def least_squares_root(problem: Problem, z: Array, x_start: Array, *, prior: float | None) -> Minima:
    """The minimum of |h(x) - z| in the metric of R next to x_start (trials, n); MAP where `prior` says by how much to
    widen the prior's deviations.

    Gauss-Newton; Levenberg-Marquardt for the trials where that fails.
    """
    objective = Objective.of(problem, z, prior=prior is not None, inflation=prior or 1.0)
    minima = minimize(objective, x_start, damping=None, tolerance=_TOLERANCE, max_iterations=20)
    rest = minima.status != Status.CONVERGED
    if rest.any():
        again = Objective.of(problem, z[rest], prior=prior is not None, inflation=prior or 1.0)
        careful = minimize(again, x_start[rest], damping=Damping(1e-3), tolerance=_TOLERANCE, max_iterations=100)
        for name in ("x", "status", "iterations", "covariance", "chi_square"):
            getattr(minima, name)[rest] = getattr(careful, name)
    return minima
