"""Implements Broyden's quasi-Newton method (Burden and Faires, Numerical Analysis, chapter 10,
algorithm 10.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.estimators.ipe import IPE, State, System


@dataclass(frozen=True)
class BroydenState(State):
    """`B` (trials, n, n) stands for J(x)^-1."""

    B: Array


@dataclass(frozen=True)
class Broyden(IPE[BroydenState]):
    """Iterates x <- x - B F(x), where B is the inverse Jacobian as the steps so far have shown it
    ("good" Broyden).

    The least change of the Jacobian that satisfies the secant equation is of rank one, so the
    Sherman-Morrison formula updates its inverse: no Jacobian after the first, no linear system,
    superlinear convergence.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"broyden": ib.solvers.Broyden(initial="identity")}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    initial: Literal["jacobian", "identity"] = "jacobian"
    """B at the start: J(x)^-1, or I, which makes the first step one of fixed-point iteration and
    needs no Jacobian."""

    def init(self, system: System, x: Array, F: Array) -> BroydenState:
        n = x.shape[1]
        columns = np.broadcast_to(np.eye(n), (len(x), n, n))
        if self.initial == "identity":
            return BroydenState(x, F, columns)
        J = system.J(x, F)
        return BroydenState(x, F, system.solve(J, columns))

    def step(self, system: System, state: BroydenState) -> BroydenState:
        s = -multiply(state.B, state.F)
        x = state.x + s
        F = system.F(x)
        By = multiply(state.B, F - state.F)
        sB = multiply(state.B.swapaxes(1, 2), s)
        scale = np.einsum("ti,ti->t", s, By)
        # s'By = 0 would make the new Jacobian singular: the old one is kept for a step.
        usable = np.abs(scale) > np.finfo(float).eps * np.einsum("ti,ti->t", s, s)
        change = (
            (s - By)[:, :, None] * sB[:, None, :] / np.where(usable, scale, np.inf)[:, None, None]
        )
        return BroydenState(x, F, state.B + change)
