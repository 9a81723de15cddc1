"""Implements steepest descent on |F|^2 (Burden and Faires, Numerical Analysis, chapter 10,
algorithm 10.3)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ipe_bench.basics.linalg import Array, divisors, multiply, squared
from ipe_bench.basics.options import Count
from ipe_bench.estimators.ipe import IPE, State, System

_HALVINGS = 40


@dataclass(frozen=True)
class SteepestDescent(IPE):
    """Iterates x <- x - alpha d along the gradient of g = |F|^2, alpha by quadratic interpolation
    at 0, alpha/2, alpha.

    The book's first trial step has length one; here it is as long as F, the step of fixed-point
    iteration. Where g no longer decreases, at a local minimum that is no root, the step is zero and
    the trial has stalled.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"descent": ib.solvers.SteepestDescent()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    max_iterations: Count = field(default=500, kw_only=True)

    def step(self, system: System, state: State) -> State:
        x = state.x
        g = squared(state.F)
        gradient = multiply(system.J(x).swapaxes(1, 2), state.F)
        length = np.linalg.norm(gradient, axis=1)
        as_long_as_F = np.sqrt(g) / divisors(length)
        d = gradient * as_long_as_F[:, None]

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

        if downhill.any():
            part = system.subset(downhill)
            start = State(x[downhill], state.F[downhill])
            alpha[downhill], F[downhill] = _interpolated(
                part, start, d[downhill], alpha[downhill], F[downhill]
            )
        return State(x - alpha[:, None] * d, F)


def _interpolated(
    system: System, start: State, d: Array, alpha: Array, F: Array
) -> tuple[Array, Array]:
    """Finds alpha_0, the minimum of the parabola through g at 0, alpha_2 = alpha_3 / 2 and alpha_3
    = `alpha`, and F there; `alpha` and F where g is smaller."""
    g1 = squared(start.F)
    g3 = squared(F)
    half = alpha / 2
    # Divided differences h1, h2 and h3 of the algorithm's step 9.
    g2 = squared(system.F(start.x - half[:, None] * d))
    h1 = (g2 - g1) / half
    h2 = (g3 - g1 - h1 * half) / (alpha - half)
    h3 = (h2 - h1) / alpha
    opens_upwards = h3 > 0
    a0 = (half - h1 / np.where(opens_upwards, h3, np.inf)) / 2
    a0 = np.where(opens_upwards, a0, alpha)
    F0 = system.F(start.x - a0[:, None] * d)
    better = squared(F0) < g3
    return np.where(better, a0, alpha), np.where(better[:, None], F0, F)
