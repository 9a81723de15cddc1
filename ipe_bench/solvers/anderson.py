"""Accelerates the fixed-point iteration by Anderson's method (Walker and Ni, SIAM J. Numer. Anal.
49, 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.basics.options import Count
from ipe_bench.estimators.ipe import IPE, State, System

_DEPENDENT = 1e-12
"""Differences of F that are the same to this share are taken for one."""


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
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"anderson": ib.solvers.Anderson(depth=3)}, trials=20)
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


def accelerated(x: Array, F: Array, dx: Array, dF: Array) -> Array:
    """Computes the next x (trials, n), from the last differences of x and of F, each (trials, n,
    depth)."""
    gamma = _least_squares(dF, F)
    return x - F - multiply(dx - dF, gamma)


def push(memory: Array, newest: Array) -> Array:
    """Pushes the newest difference (trials, n) in front of the memory (trials, n, depth), and drops
    the oldest."""
    return np.concatenate([newest[:, :, None], memory[:, :, :-1]], axis=2)


def _least_squares(A: Array, b: Array) -> Array:
    """Computes the shortest gamma that minimises |b - A gamma|, with columns of A (trials, n,
    depth) scaled to 1."""
    length = np.linalg.norm(A, axis=1)
    usable = (length > 0) & np.isfinite(length)
    # A column of infinite length has no part in gamma.
    length = np.where(usable, length, np.inf)
    scaled = np.nan_to_num(A / length[:, None, :], nan=0.0, posinf=0.0, neginf=0.0)
    gamma = multiply(np.linalg.pinv(scaled, rcond=_DEPENDENT), b)
    return gamma / length
