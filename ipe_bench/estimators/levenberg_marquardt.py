"""The Levenberg-Marquardt method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import Array
from ipe_bench.estimators.driver import Solver, Standing
from ipe_bench.estimators.least_squares import Descent, Objective, Slope, squared

_LARGEST_DAMPING = 1e30
_ROUND_OFF = 1e-8
"""A predicted decrease below this share of the objective cannot be seen in the objective any more."""


@dataclass(frozen=True)
class LevenbergMarquardtMethod(Solver[Descent]):
    """The step minimises |r + J s|^2 + lambda |D s|^2, and lambda follows the gain ratio.

    D = 1 / `deviation` (n,), the metric of a prior covariance; None: Marquardt's, the column norms of J, which only
    grow (More, in Numerical Analysis, LNM 630, 1978). lambda by Nielsen's rule (Madsen, Nielsen, Tingleff, Methods for
    Non-Linear Least Squares Problems, 2004, eq. 2.21).
    """

    damping: float
    """lambda at the start."""
    deviation: Array | None = None

    def begin(self, objective: Objective, x: Array) -> Descent:
        return Descent.at(objective, x, self.damping)

    def step(self, objective: Objective, state: Descent) -> Descent:
        step, predicted = state.slope.damped(np.sqrt(state.lam)[:, None] * self._metric(state))
        r = objective.residual(state.x + step)
        cost = squared(r)
        gain = (state.cost - cost) / predicted
        invisible = (predicted <= _ROUND_OFF * state.cost) & (np.abs(cost - state.cost) <= 2 * _ROUND_OFF * state.cost)
        taken = (gain > 0) | invisible
        eased = state.lam * np.maximum(1 / 3, 1 - (2 * np.clip(np.where(invisible, 1.0, gain), 0, 1) - 1) ** 3)
        x = np.where(taken[:, None], state.x + step, state.x)
        r = np.where(taken[:, None], r, state.r)
        slope = state.slope
        if taken.any():
            slope = put(slope, taken, Slope.of(objective.subset(taken).jacobian(x[taken]), r[taken]))
        return Descent(
            x,
            r,
            np.where(taken, cost, state.cost),
            slope,
            state.reach(step),
            np.where(taken, eased, state.lam * state.growth),
            np.where(taken, 2.0, 2.0 * state.growth),
            np.fmax(state.scale, slope.columns),
        )

    def standing(self, objective: Objective, before: Descent | None, state: Descent) -> Standing:
        """Damping goes on where J lacks rank, until it can gain nothing more."""
        return state.standing(stuck=state.lam > _LARGEST_DAMPING)

    def _metric(self, state: Descent) -> Array:
        """The diagonal of D (trials, n)."""
        return state.scale if self.deviation is None else np.broadcast_to(1.0 / self.deviation, state.scale.shape)
