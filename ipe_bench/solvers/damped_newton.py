"""Adds a line search to Newton's method (Dennis, Schnabel, Numerical Methods for Unconstrained
Optimization, 6.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt, Lt

from ipe_bench.basics.linalg import Array, finite
from ipe_bench.estimators.ipe import IPE, State, System

_HALVINGS = 30
"""The halvings of a step before the trial counts as stalled."""


@dataclass(frozen=True)
class DampedNewton(IPE):
    """Iterates x <- x - t J(x)^-1 F(x) with t = 1, 1/2, 1/4, ... until |F| has decreased enough
    (Armijo's rule).

    Newton's method near a root. A trial whose |F| decreases for no t stays where it is, and has
    stalled.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"damped": ib.solvers.DampedNewton()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    decrease: Annotated[float, Gt(0), Lt(1)] = 1e-4
    """The share of the decrease that the slope promises which is enough."""

    def step(self, system: System, state: State) -> State:
        direction = -system.solve(system.J(state.x, state.F), state.F)
        size = _norm(state.F)
        t = np.ones(len(size))
        F = system.F(state.x + direction)
        # A singular trial has no direction to search along: its NaN goes back to the driver at
        # once.
        searching = finite(direction)
        for _ in range(_HALVINGS):
            searching &= ~(_norm(F) <= (1 - self.decrease * t) * size)
            if not searching.any():
                break
            t[searching] /= 2
            shorter = state.x[searching] + t[searching, None] * direction[searching]
            F[searching] = system.subset(searching).F(shorter)
        failed = searching & ~(_norm(F) < size)
        t = np.where(failed, 0.0, t)
        return State(state.x + t[:, None] * direction, np.where(failed[:, None], state.F, F))


def _norm(F: Array) -> Array:
    return np.linalg.norm(F, axis=1)
