"""The iterated extended Kalman filter, on filterpy's EKF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.baselines.ekf import EKFStack, EKFTrack, turned_by_slopes
from ipe_bench.baselines.epochs import Rows
from ipe_bench.baselines.sequential import Sequential, squared_innovation
from ipe_bench.basics.linalg import Array, Mask, deviations, multiply
from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class IteratedEKF(Sequential):
    """An EKF that linearises each epoch's readings again at its updated estimate until that stays: Gauss-Newton on the
    epoch's readings and the prior that the earlier epochs left (Bell and Cathey, IEEE TAC 38, 1993)."""

    max_iterations: Count = 20
    """Linearisations per epoch; one that has not settled by then goes on from where it is."""
    tolerance: Positive = 1e-3
    """Largest change of a parameter, in deviations of the updated P, at which an epoch is done."""

    slopes = True

    def track(self, P0: Array, Q: Array, z: Array) -> IteratedEKFTrack:
        return IteratedEKFTrack(P0, Q, self)

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> IteratedEKFStack:
        return IteratedEKFStack(P0, Q, problem, z, self)


class IteratedEKFTrack(EKFTrack):
    """filterpy's update, begun again from the epoch's prior with the readings linearised at the last estimate."""

    def __init__(self, P0: Array, Q: Array, given: IteratedEKF) -> None:
        super().__init__(P0, Q)
        self.given, self.iteration = given, 0

    def predict(self) -> None:
        super().predict()
        self.iteration = 0

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        assert H is not None
        f, at = self.filter, self.filter.x
        f.x, f.P = f.x_prior, f.P_prior
        # What the readings linearised at the last estimate say at the prior mean.
        z, h, H = turned_by_slopes(z, h[0] + H @ (f.x - at), H, f.P)
        f.update(z, HJacobian=lambda _: H, Hx=lambda _: h, R=np.eye(len(z)))
        self.iteration += 1
        if self.iteration == 1:
            # The innovation of the prediction; later ones have seen z.
            self.nis += squared_innovation(f.y, f.SI)
        change = np.abs(f.x - at) / np.sqrt(np.diag(f.P))
        return self.iteration >= self.given.max_iterations or bool(change.max() <= self.given.tolerance)


class IteratedEKFStack(EKFStack):
    """The same filter for all trials at once."""

    def __init__(self, P0: Array, Q: Array, problem: Problem, z: Array, given: IteratedEKF) -> None:
        super().__init__(P0, Q, problem, z)
        self.given, self.iteration = given, 0
        self.x_prior, self.P_prior = self.x, self.P

    def predict(self, at: Rows) -> None:
        super().predict(at)
        self.x_prior, self.P_prior, self.iteration = self.x.copy(), self.P.copy(), 0

    def update(self, at: Rows, z: Array, h: Array, H: Array | None) -> Mask:
        assert H is not None
        x, before = self.x_prior[at], self.x[at]
        y = z - h[:, 0] - multiply(H, x - before)
        squared = self.linear_update(at, x, self.P_prior[at], y, H)
        self.iteration += 1
        if self.iteration == 1:
            # The innovation of the prediction; later ones have seen z.
            self.nis[at] += squared
        change = (np.abs(self.x[at] - before) / deviations(self.P[at])).max(axis=1)
        return (change <= self.given.tolerance) | (self.iteration >= self.given.max_iterations)
