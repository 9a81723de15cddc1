"""The cubature Kalman filter, filterpy's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.baselines.batched import Stack
from ipe_bench.baselines.sequential import Sequential, Track, in_turn, squared_innovation, turned
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.problem import Problem
from ipe_bench.states.algebra import symmetric
from ipe_bench.states.linearisation import Cubature


@dataclass(frozen=True)
class CKF(Sequential):
    """Readings at 2n cubature points, sqrt(n) deviations out (Arasaratnam and Haykin, IEEE TAC 54, 2009)."""

    def track(self, P0: Array, Q: Array, z: Array) -> CKFTrack:
        return CKFTrack(P0, Q)

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> Stack:
        return Stack(Cubature(), P0, Q, problem, z)


class CKFTrack(Track):
    """filterpy's CubatureKalmanFilter on one trial.

    It takes moments as mean(X X') - x x', which loses what x is larger than its deviation, squared. So the filter's
    state is the distance from a reference that moves to the estimate after each epoch, and its readings are distances
    from the points' mean: the same filter, with nothing to cancel.
    """

    def __init__(self, P0: Array, Q: Array) -> None:
        from filterpy.kalman import CubatureKalmanFilter

        n = len(P0)
        self.reference = np.zeros(n)
        self.filter: Any = CubatureKalmanFilter(dim_x=n, dim_z=1, dt=1.0, hx=None, fx=lambda x, dt: x)
        self.filter.x, self.filter.P, self.filter.Q = np.zeros((n, 1)), P0, Q

    @property
    def x(self) -> Array:
        return self.reference

    @property
    def P(self) -> Array:
        return self.filter.P

    def predict(self) -> None:
        from filterpy.kalman import spherical_radial_sigmas

        if self.filter.Q.any():
            self.filter.predict()
        # filterpy leaves the points of before the process noise; the filter's authors draw them anew.
        self.filter.sigmas_f = spherical_radial_sigmas(self.filter.x, self.filter.P)

    def points(self) -> Array:
        return self.reference + self.filter.sigmas_f

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        f = self.filter
        z, h = turned(z, h)
        f.hx = in_turn(h)
        f.sigmas_h = np.empty_like(h)
        # A flat z would make x a matrix: filterpy's x is a column here.
        f.update(z[:, None], R=np.eye(len(z)))
        f.P = symmetric(f.P)
        self.nis += squared_innovation(f.y, f.SI)
        self.reference = self.reference + f.x[:, 0]
        f.x = np.zeros_like(f.x)
        return True
