"""Finds roots of the estimating equations from given points: started at the truth, they expose a false root.

Nothing here is an estimator: an estimator does not know where to start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import Array
from ipe_bench.estimators.driver import E, Limits, Method, iterate
from ipe_bench.estimators.ipe import IPE, FrozenSystem, State, System
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import GaussNewtonMethod, LevenbergMarquardtMethod
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.newton import Newton

_TOLERANCE = 1e-6


@dataclass(frozen=True)
class _ChordState(State):
    J: Array


@dataclass(frozen=True)
class _Chord(IPE[_ChordState]):
    """Iterates x <- x - J(x_start)^-1 F(x): Newton's method with the first Jacobian kept."""

    def init(self, system: System, x: Array, F: Array) -> _ChordState:
        return _ChordState(x, F, system.J(x))

    def step(self, system: System, state: _ChordState) -> _ChordState:
        x = state.x - system.solve(state.J, state.F)
        return _ChordState(x, system.F(x), state.J)


def frozen_root(problem: Problem, z: Array, x_start: Array) -> Array:
    """Finds the root (trials, n) of the frozen equation (11) next to x_start (trials, n), for readings z (trials, m);
    NaN where there is none.

    Chord steps with the Jacobian at x_start, which is enough where x_start is the truth; Newton's method for the trials
    where it is not.
    """
    return _first_root(lambda z: FrozenSystem.at_nominal(problem, z), z, x_start, (_Chord(), 8), (Newton(), 20))


def least_squares_root(problem: Problem, z: Array, x_start: Array, *, prior: float | None) -> Array:
    """Finds the minimum (trials, n) of |h(x) - z| in the metric of R next to x_start (trials, n); MAP where `prior`
    says by how much to widen the prior's deviations. NaN where none is found.

    Gauss-Newton; Levenberg-Marquardt for the trials where that fails.
    """
    methods = (GaussNewtonMethod(), 20), (LevenbergMarquardtMethod(1e-3), 100)
    return _first_root(lambda z: Objective.of(problem, z, prior), z, x_start, *methods)


def _first_root(
    equations: Callable[[Array], E], z: Array, x_start: Array, *attempts: tuple[Method[E, Any], int]
) -> Array:
    """Returns the end of the first method that converges: each has that many iterations from x_start."""
    x, missing = np.full(x_start.shape, np.nan), np.arange(len(z))
    for method, limit in attempts:
        if len(missing):
            ended = iterate(equations(z[missing]), method, x_start[missing], Limits(_TOLERANCE, limit))
            x = put(x, missing[ended.converged], ended.x[ended.converged])
            missing = missing[~ended.converged]
    return x
