"""Finds roots of the estimating equations from given points: started at the truth, they expose a
false root.

Nothing here is an estimator: an estimator does not know where to start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.estimators.driver import E, Limits, Method, iterate
from ipe_bench.estimators.ipe import IPE, FrozenSystem, State, System
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import GaussNewtonMethod, LevenbergMarquardtMethod
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.newton import Newton

_TOLERANCE = 1e-6
Known = tuple[Array, ...]
"""Readings (trials, m) and Jacobians (trials, m, n) at a point; empty if they are not known."""


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


@dataclass(frozen=True)
class _Informed(CountingModel):
    """Evaluates a model, but for the start of an iteration, where readings and Jacobian are
    known."""

    start: Array = field(default_factory=lambda: np.empty(0))
    known: Known = ()

    def simulate(self, x: Array, rows: NDArray[np.intp]) -> Array:
        if self.known and x is self.start:
            return self.known[0]
        return super().simulate(x, rows)

    def jacobian(self, x: Array, rows: NDArray[np.intp], *, coarse: Mask | bool = False) -> Array:
        if self.known and x is self.start and not np.any(coarse):
            return self.known[1]
        return super().jacobian(x, rows, coarse=coarse)


def frozen_root(problem: Problem, z: Array, x_start: Array, known: Known = ()) -> Array:
    """Finds the root (trials, n) of the frozen equation (11) next to x_start (trials, n), for
    readings z (trials, m); NaN where there is none. `known` holds h (trials, m) and dh/dx (trials,
    m, n) at x_start, if they are known.

    Chord steps with the Jacobian at x_start, which is enough where x_start is the truth; Newton's
    method for the trials where it is not.
    """

    def system(kept: NDArray[np.intp], model: CountingModel) -> FrozenSystem:
        return replace(FrozenSystem.at_nominal(problem, z[kept]), model=model)

    return _first_root(system, problem, x_start, known, (_Chord(), 8), (Newton(), 20))


def least_squares_root(
    problem: Problem, z: Array, x_start: Array, *, prior: float | None, known: Known = ()
) -> Array:
    """Finds the minimum (trials, n) of |h(x) - z| in the metric of R next to x_start (trials, n);
    MAP where `prior` says by how much to widen the prior's deviations. NaN where none is found.
    `known` is that of `frozen_root`.

    Gauss-Newton; Levenberg-Marquardt for the trials where that fails.
    """

    def objective(kept: NDArray[np.intp], model: CountingModel) -> Objective:
        return replace(Objective.of(problem, z[kept], prior), model=model)

    methods = (GaussNewtonMethod(), 20), (LevenbergMarquardtMethod(1e-3), 100)
    return _first_root(objective, problem, x_start, known, *methods)


def _first_root(
    equations: Callable[[NDArray[np.intp], CountingModel], E],
    problem: Problem,
    x_start: Array,
    known: Known,
    *attempts: tuple[Method[E, Any], int],
) -> Array:
    """Returns the end of the first method that converges: each has that many iterations from
    x_start."""
    x = np.full(x_start.shape, np.nan)
    missing = np.arange(len(x_start))
    for method, limit in attempts:
        if not len(missing):
            break
        start = x_start[missing]
        tally = EvaluationCount.zeros(len(missing))
        known_there = tuple(a[missing] for a in known)
        model = _Informed(problem.measurement, tally, start=start, known=known_there)
        ended = iterate(equations(missing, model), method, start, Limits(_TOLERANCE, limit))
        x = put(x, missing[ended.converged], ended.x[ended.converged])
        missing = missing[~ended.converged]
    return x
