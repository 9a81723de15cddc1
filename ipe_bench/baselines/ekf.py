"""The extended Kalman filter, filterpy's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.baselines.batched import Stack, gain_of, principal_axes, squared_innovations
from ipe_bench.baselines.epochs import Rows
from ipe_bench.baselines.sequential import Sequential, Track, refuse_overflow, squared_innovation
from ipe_bench.basics.linalg import Array, Mask, multiply
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class EKF(Sequential):
    """Each epoch's readings linearised at the estimate so far (Bar-Shalom et al., 10.3). filterpy updates P in Joseph's
    form, (I - K H) P (I - K H)' + K R K', which stays positive definite where the prior is much wider than R."""

    slopes = True

    def track(self, P0: Array, Q: Array, z: Array) -> EKFTrack:
        return EKFTrack(P0, Q)

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> EKFStack:
        return EKFStack(P0, Q, problem, z)


class EKFTrack(Track):
    """filterpy's ExtendedKalmanFilter on one trial."""

    def __init__(self, P0: Array, Q: Array) -> None:
        from filterpy.kalman import ExtendedKalmanFilter

        n = len(P0)
        self.filter = ExtendedKalmanFilter(dim_x=n, dim_z=1)
        # The default x is a column, with which a vector of readings broadcasts to a matrix and no error.
        self.filter.x = np.zeros(n)
        self.filter.P, self.filter.Q = P0, Q

    @property
    def x(self) -> Array:
        return self.filter.x

    @property
    def P(self) -> Array:
        return self.filter.P

    def predict(self) -> None:
        self.filter.predict()

    def points(self) -> Array:
        return self.filter.x[None]

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        assert H is not None
        z, h, H = turned_by_slopes(z, h[0], H, self.filter.P)
        self.filter.update(z, HJacobian=lambda _: H, Hx=lambda _: h, R=np.eye(len(z)))
        self.nis += squared_innovation(self.filter.y, self.filter.SI)
        return True


def turned_by_slopes(z: Array, h: Array, H: Array, P: Array) -> tuple[Array, Array, Array]:
    """White readings z and h (m,) and their slopes H (m, n) along the principal axes of H P H' (see `turned`)."""
    S = H @ P @ H.T
    refuse_overflow(S)
    axes = np.linalg.eigh(S)[1][:, ::-1].T
    return axes @ z, axes @ h, axes @ H


class EKFStack(Stack):
    """The same filter for all trials at once."""

    slopes = True

    def points(self, at: Rows) -> Array:
        return self.x[at][:, None]

    def update(self, at: Rows, z: Array, h: Array, H: Array | None) -> Mask | bool:
        assert H is not None
        self.nis[at] += self.linear_update(at, self.x[at], self.P[at], z - h[:, 0], H)
        return True

    def linear_update(self, at: Rows, x: Array, P: Array, y: Array, H: Array) -> Array:
        """From the priors x and P and the innovations y (trials, m); returns y' S^-1 y (trials,)."""
        axes = principal_axes(np.matmul(np.matmul(H, P), H.swapaxes(1, 2)))
        y, H = multiply(axes.swapaxes(1, 2), y), np.matmul(axes.swapaxes(1, 2), H)
        PHT = np.matmul(P, H.swapaxes(1, 2))
        S = np.matmul(H, PHT) + np.eye(y.shape[1])
        K = gain_of(PHT, S)
        I_KH = np.eye(P.shape[1]) - np.matmul(K, H)
        self.x[at] = x + multiply(K, y)
        self.P[at] = np.matmul(np.matmul(I_KH, P), I_KH.swapaxes(1, 2)) + np.matmul(K, K.swapaxes(1, 2))
        return squared_innovations(y, S)
