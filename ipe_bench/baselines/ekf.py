"""The extended Kalman filter, plain and iterated, filterpy's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.baselines.batched import Stack
from ipe_bench.baselines.sequential import Sequential, Track, refuse_overflow, squared_innovation
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements.problem import Problem
from ipe_bench.states.linearisation import Taylor


@dataclass(frozen=True)
class EKF(Sequential):
    """Each epoch's readings linearised at the estimate so far (Bar-Shalom et al., 10.3). filterpy updates P in Joseph's
    form, (I - K H) P (I - K H)' + K R K', which stays positive definite where the prior is much wider than R."""

    slopes = True

    def track(self, P0: Array, Q: Array, z: Array) -> EKFTrack:
        return EKFTrack(P0, Q)

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> Stack:
        return Stack(Taylor(), P0, Q, problem, z)


@dataclass(frozen=True)
class IteratedEKF(Sequential):
    """An EKF that linearises each epoch's readings again at its updated estimate until that stays: Gauss-Newton on the
    epoch's readings and the prior that the earlier epochs left (Bell and Cathey, IEEE TAC 38, 1993)."""

    max_iterations: Count = 20
    """Linearisations per epoch; one that has not settled by then goes on from where it is."""
    tolerance: Positive = 1e-3
    """Largest change of a parameter, in deviations of the updated P, at which an epoch is done."""

    slopes = True

    def track(self, P0: Array, Q: Array, z: Array) -> EKFTrack:
        return EKFTrack(P0, Q, self.max_iterations, self.tolerance)

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> Stack:
        return Stack(Taylor(), P0, Q, problem, z, self.max_iterations, self.tolerance)


class EKFTrack(Track):
    """filterpy's ExtendedKalmanFilter on one trial. An iteration begins its update again from the epoch's prior, with
    the readings linearised at the last estimate."""

    def __init__(self, P0: Array, Q: Array, iterations: int = 1, tolerance: float = 0.0) -> None:
        from filterpy.kalman import ExtendedKalmanFilter

        n = len(P0)
        self.filter = ExtendedKalmanFilter(dim_x=n, dim_z=1)
        # The default x is a column, with which a vector of readings broadcasts to a matrix and no error.
        self.filter.x = np.zeros(n)
        self.filter.P, self.filter.Q = P0, Q
        self.iterations, self.tolerance, self.iteration = iterations, tolerance, 0

    @property
    def x(self) -> Array:
        return self.filter.x

    @property
    def P(self) -> Array:
        return self.filter.P

    def predict(self) -> None:
        self.filter.predict()
        self.iteration = 0

    def points(self) -> Array:
        return self.filter.x[None]

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
        return self.iteration >= self.iterations or bool(change.max() <= self.tolerance)


def turned_by_slopes(z: Array, h: Array, H: Array, P: Array) -> tuple[Array, Array, Array]:
    """White readings z and h (m,) and their slopes H (m, n) along the principal axes of H P H' (see `turned`)."""
    S = H @ P @ H.T
    refuse_overflow(S)
    axes = np.linalg.eigh(S)[1][:, ::-1].T
    return axes @ z, axes @ h, axes @ H
