"""Roots of the estimating equations from given points: started at the truth, they tell a false root from the right one.

Nothing here is an estimator: an estimator does not know where to start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.estimators.driver import Limits, Solver, iterate
from ipe_bench.estimators.ipe import IPE, FrozenSystem, State, System
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import GaussNewtonMethod, LevenbergMarquardtMethod
from ipe_bench.measurements.counted import CountingModel
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.newton import Newton

_TOLERANCE = 1e-6


@dataclass(frozen=True)
class _ChordState(State):
    J: Array


@dataclass(frozen=True)
class _Chord(IPE[_ChordState]):
    """x <- x - J(x_start)^-1 F(x): Newton's method with the first Jacobian kept."""

    def init(self, system: System, x: Array, F: Array) -> _ChordState:
        return _ChordState(x, F, system.J(x))

    def step(self, system: System, state: _ChordState) -> _ChordState:
        x = state.x - system.solve(state.J, state.F)
        return _ChordState(x, system.F(x), state.J)


@dataclass(frozen=True)
class Known:
    """What the model says at starts x (trials, n), where that is known already."""

    J: Array
    """dh/dx (trials, m, n)."""
    h: Array | None = None
    """h (trials, m)."""


@dataclass(frozen=True, kw_only=True)
class _Informed(CountingModel):
    """A model that does not compute again what is known at the starts x (trials, n)."""

    x: Array
    known: Known

    def simulate(self, x: Array, rows: NDArray[np.intp]) -> Array:
        h = self.known.h
        return super().simulate(x, rows) if h is None or not self._at_start(x, rows) else h[rows]

    def jacobian(self, x: Array, rows: NDArray[np.intp], *, coarse: Mask | bool = False) -> Array:
        if not self._at_start(x, rows):
            return super().jacobian(x, rows, coarse=coarse)
        J = self.known.J
        return J if len(rows) == len(J) else J[rows]

    def _at_start(self, x: Array, rows: NDArray[np.intp]) -> bool:
        return np.array_equal(x, self.x[rows])


def frozen_root(problem: Problem, z: Array, x_start: Array, known: Known | None = None) -> Array:
    """The root (trials, n) of the frozen equation (11) next to x_start (trials, n), for readings z (trials, m); NaN
    where there is none.

    Chord steps with the Jacobian at x_start, which is enough where x_start is the truth; Newton's method for the trials
    where it is not.
    """
    attempts = ((_Chord(), 8), (Newton(), 20))
    return _first_root(lambda z: FrozenSystem.at_nominal(problem, z), attempts, z, x_start, known)


def least_squares_root(
    problem: Problem, z: Array, x_start: Array, known: Known | None = None, *, prior: float | None
) -> Array:
    """The minimum (trials, n) of |h(x) - z| in the metric of R next to x_start (trials, n); MAP where `prior` says by
    how much to widen the prior's deviations. NaN where none is found.

    Gauss-Newton; Levenberg-Marquardt for the trials where that fails.
    """

    def objective(z: Array) -> Objective:
        return Objective.of(problem, z, prior=prior is not None, inflation=prior or 1.0)

    attempts = ((GaussNewtonMethod(), 20), (LevenbergMarquardtMethod(1e-3), 100))
    return _first_root(objective, attempts, z, x_start, known)


def _first_root(
    equations: Callable[[Array], Any],
    attempts: Sequence[tuple[Solver[Any], int]],
    z: Array,
    x_start: Array,
    known: Known | None,
) -> Array:
    """Where the first method that converges ends: each has that many iterations from x_start."""
    x, missing = np.full(x_start.shape, np.nan), np.arange(len(z))
    for method, limit in attempts:
        if len(missing):
            system, start = equations(z[missing]), x_start[missing]
            if known is not None:
                here = known if len(missing) == len(z) else take(known, missing)
                informed = _Informed(system.model.measurement, system.model.tally, x=start, known=here)
                system = replace(system, model=informed)
            ended = iterate(system, method, start, Limits(_TOLERANCE, limit))
            x = put(x, missing[ended.converged], ended.x[ended.converged])
            missing = missing[~ended.converged]
    return x
