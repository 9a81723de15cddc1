"""The iterated extended Kalman filter, on filterpy's EKF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.baselines.ekf import EKFTrack, turned_by_slopes
from ipe_bench.baselines.sequential import Sequential, squared_innovation
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive


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
        return IteratedEKFTrack(P0, Q, self.max_iterations, self.tolerance)


class IteratedEKFTrack(EKFTrack):
    """filterpy's update, begun again from the epoch's prior with the readings linearised at the last estimate."""

    def __init__(self, P0: Array, Q: Array, max_iterations: int, tolerance: float) -> None:
        super().__init__(P0, Q)
        self.max_iterations, self.tolerance = max_iterations, tolerance
        self.iteration = 0

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
        return self.iteration >= self.max_iterations or bool(change.max() <= self.tolerance)
