"""The recursive update filter: each epoch's readings taken in by small steps, linearised anew at each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.baselines.information import Belief, EpochReadings, InformationFilter
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive


@dataclass(frozen=True)
class RecursiveUpdate(InformationFilter):
    """Zanetti's idea (IEEE TAC 57, 2012): an extended Kalman filter moves a part of the way and linearises again.

    A step takes in the readings as if their information were w_k R^-1, with weights w_k that add up to 1. Equal weights
    fail where the noise is far below the prior: the first of them is nearly a full update. Here they are in geometric
    progression, so that each step multiplies what is known by about the same factor, and the first is such that the
    largest eigenvalue of w_1 H P H' (H whitened) is about `first`. On a linear model all this is the Kalman filter.
    """

    steps: Count = 8
    """Linearisations per epoch."""
    first: Positive = 100.0
    """The information of the first step over that of the prior, in the direction that the readings see best."""

    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        belief = readings.belief
        r, J = readings.misfit(belief.mean), readings.slope(belief.mean)
        innovations = belief.given(J, r, belief.mean)[1]
        weights = geometric_weights(1.0 + _strength(J, belief) / self.first, self.steps)
        for k in range(self.steps):
            if k:
                r, J = readings.misfit(belief.mean), readings.slope(belief.mean)
            root = np.sqrt(weights[:, k, None])
            belief, _ = belief.given(root[:, :, None] * J, root * r, belief.mean)
        return belief, innovations


def geometric_weights(ratio: Array, steps: int) -> Array:
    """Weights (trials, steps) that add up to 1, the last `ratio` (trials,) times the first."""
    weights = ratio[:, None] ** (np.arange(steps) / max(steps - 1, 1))
    return weights / weights.sum(axis=1, keepdims=True)


def _strength(J: Array, belief: Belief) -> Array:
    """The largest eigenvalue of H P H' (trials,) for whitened slopes H."""
    moved = np.matmul(J, belief.root())
    moved = np.where(np.isfinite(moved).all(axis=(1, 2), keepdims=True), moved, 0.0)
    return np.linalg.norm(moved, ord=2, axis=(1, 2)) ** 2
