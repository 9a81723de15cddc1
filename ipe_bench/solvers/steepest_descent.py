"""Implements steepest descent on |F|^2 (Burden and Faires, Numerical Analysis, chapter 10, algorithm 10.3)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ipe_bench.basics.linalg import multiply, squared
from ipe_bench.basics.options import Count
from ipe_bench.estimators.ipe import IPE, State, System

_HALVINGS = 40


@dataclass(frozen=True)
class SteepestDescent(IPE):
    """Iterates x <- x - alpha d along the gradient of g = |F|^2, alpha by quadratic interpolation at 0, alpha/2, alpha.

    The book's first trial step has length one; here it is as long as F, the step of fixed-point iteration. Where g no
    longer decreases, at a local minimum that is no root, the step is zero and the trial has stalled.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"descent": ib.solvers.SteepestDescent()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    max_iterations: Count = field(default=500, kw_only=True)

    def step(self, system: System, state: State) -> State:
        x, g = state.x, squared(state.F)
        gradient = multiply(system.J(x).swapaxes(1, 2), state.F)
        length = np.linalg.norm(gradient, axis=1)
        d = gradient * (np.sqrt(g) / np.where(length > 0, length, 1.0))[:, None]

        # alpha_3: halved until g is below its value at the start.
        alpha = np.ones(len(x))
        F = system.F(x - d)
        for _ in range(_HALVINGS):
            uphill = ~(squared(F) < g)
            if not uphill.any():
                break
            alpha[uphill] /= 2
            F[uphill] = system.subset(uphill).F(x[uphill] - alpha[uphill, None] * d[uphill])
        downhill = squared(F) < g
        alpha = np.where(downhill, alpha, 0.0)
        F = np.where(downhill[:, None], F, state.F)

        # alpha_0: the minimum of the parabola through g at 0, alpha_2 = alpha_3 / 2 and alpha_3.
        if downhill.any():
            rows = system.subset(downhill)
            x_d, d_d, a3, g1, g3 = (
                x[downhill],
                d[downhill],
                alpha[downhill],
                g[downhill],
                squared(F[downhill]),
            )
            a2 = a3 / 2
            h1 = (squared(rows.F(x_d - a2[:, None] * d_d)) - g1) / a2
            h2 = (g3 - g1 - h1 * a2) / (a3 - a2)
            h3 = (h2 - h1) / a3
            a0 = (a2 - h1 / np.where(h3 > 0, h3, np.inf)) / 2
            a0 = np.where(h3 > 0, a0, a3)
            F0 = rows.F(x_d - a0[:, None] * d_d)
            better = squared(F0) < g3
            alpha[downhill] = np.where(better, a0, a3)
            F[downhill] = np.where(better[:, None], F0, F[downhill])
        return State(x - alpha[:, None] * d, F)
