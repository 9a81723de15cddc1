"""Accelerates the fixed-point iteration of IPE by Anderson's method, as an estimator of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count
from ipe_bench.estimators.ipe import IPE, State, System
from ipe_bench.solvers.anderson import accelerated, push


@dataclass(frozen=True)
class AndersonState(State):
    """Holds the last `depth` differences of x and F, each (trials, n, depth), newest first; zero if
    there are fewer."""

    dx: Array
    dF: Array


@dataclass(frozen=True)
class Anderson(IPE[AndersonState]):
    """Iterates x <- g(x) - sum of gamma_j times the j-th last difference of g, where gamma
    minimises |F - dF gamma|.

    The fixed-point step g(x) = x - F(x) corrected by what the last `depth` steps say of the slope:
    no Jacobian, one evaluation a step. Depth 1 is a secant method; depth n is one of Broyden's.

    Example:

    >>> import ipe_bench as ib
    >>> from ipe_bench_zoo import Anderson
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"anderson": Anderson(depth=3)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    depth: Count = 5

    def init(self, system: System, x: Array, F: Array) -> AndersonState:
        depth = min(self.depth, x.shape[1])
        none = np.zeros((*x.shape, depth))
        return AndersonState(x, F, none, none)

    def step(self, system: System, state: AndersonState) -> AndersonState:
        x = accelerated(state.x, state.F, state.dx, state.dF)
        F = system.F(x)
        dx = push(state.dx, x - state.x)
        dF = push(state.dF, F - state.F)
        return AndersonState(x, F, dx, dF)
