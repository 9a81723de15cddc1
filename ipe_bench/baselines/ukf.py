"""The unscented Kalman filter, filterpy's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Le

from ipe_bench.baselines.batched import Stack
from ipe_bench.baselines.sequential import Sequential, Track, in_turn, squared_innovation, turned
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Finite, NonNegative
from ipe_bench.measurements.problem import Problem
from ipe_bench.states.algebra import symmetric
from ipe_bench.states.linearisation import Unscented


@dataclass(frozen=True)
class UKF(Sequential):
    """Readings at 2n + 1 sigma points stand for the slopes (van der Merwe, dissertation, 2004).

    The points lie at alpha sqrt(n + kappa) deviations. An alpha of 1e-3, as often advised, gives the centre a weight
    of -1e6 and costs as many digits; 0.1 does not.
    """

    alpha: Annotated[float, Gt(0), Le(1)] = 0.1
    beta: Finite = 2.0
    """2 is best for Gaussian parameters."""
    kappa: NonNegative = 0.0

    def track(self, P0: Array, Q: Array, z: Array) -> UKFTrack:
        from filterpy.kalman import MerweScaledSigmaPoints

        return UKFTrack(P0, Q, MerweScaledSigmaPoints(len(P0), self.alpha, self.beta, self.kappa))

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> Stack:
        return Stack(Unscented(self.kappa, self.alpha, self.beta), P0, Q, problem, z)


class UKFTrack(Track):
    """filterpy's UnscentedKalmanFilter on one trial."""

    def __init__(self, P0: Array, Q: Array, points: Any) -> None:
        from filterpy.kalman import UnscentedKalmanFilter

        n = len(P0)
        # hx differs from epoch to epoch, so update is given it.
        self.filter = UnscentedKalmanFilter(dim_x=n, dim_z=1, dt=1.0, hx=None, fx=lambda x, dt: x, points=points)
        self.filter.x, self.filter.P, self.filter.Q = np.zeros(n), P0, Q

    @property
    def x(self) -> Array:
        return self.filter.x

    @property
    def P(self) -> Array:
        return self.filter.P

    def predict(self) -> None:
        if self.filter.Q.any():
            self.filter.predict()
        else:
            # Constants without process noise: the moments of their sigma points are x and P themselves.
            self.filter.compute_process_sigmas(dt=1.0)

    def points(self) -> Array:
        return self.filter.sigmas_f

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        f = self.filter
        z, h = turned(z, h)
        f.update(z, R=np.eye(len(z)), hx=in_turn(h))
        f.P = symmetric(f.P)
        self.nis += squared_innovation(f.y, f.SI)
        return True
