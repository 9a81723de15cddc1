"""The ensemble Kalman filter, filterpy's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt

from ipe_bench.baselines.sequential import Sequential, Track, in_turn, squared_innovation, turned
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Whole
from ipe_bench.basics.streams import own_bits
from ipe_bench.states.algebra import symmetric


@dataclass(frozen=True)
class EnKF(Sequential):
    """An ensemble of states with perturbed readings (Evensen 1994; Crassidis and Junkins, 2nd ed., 4.5).

    Without process noise the ensemble keeps within the span of its first draw, and P carries a sampling error of about
    sqrt(2 / members): more members than parameters are needed, and many more for a P to be believed.
    """

    members: Annotated[int, Gt(1)] = 100
    seed: Whole = 0
    """A trial's random stream depends on this and on its readings: on nothing else in the batch."""

    family = "ensembles"

    def track(self, P0: Array, Q: Array, z: Array) -> EnKFTrack:
        return EnKFTrack(P0, Q, self.members, own_bits(self.seed, z))


class EnKFTrack(Track):
    """filterpy's EnsembleKalmanFilter on one trial, with a random stream of its own."""

    def __init__(self, P0: Array, Q: Array, members: int, stream: np.random.BitGenerator) -> None:
        from filterpy.kalman import EnsembleKalmanFilter

        self.stream = stream
        with _drawing_from(stream):
            x = np.zeros(len(P0))
            self.filter: Any = EnsembleKalmanFilter(x=x, P=P0, dim_z=1, dt=1.0, N=members, hx=None, fx=lambda x, dt: x)
        self.filter.Q = Q

    @property
    def x(self) -> Array:
        return self.filter.x

    @property
    def P(self) -> Array:
        return self.filter.P

    def predict(self) -> None:
        with _drawing_from(self.stream):
            self.filter.predict()

    def points(self) -> Array:
        return self.filter.sigmas

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        f = self.filter
        z, h = turned(z, h)
        f.hx = in_turn(h)
        f._mean_z = np.zeros(len(z))  # filterpy draws the perturbations about it; epochs differ in length
        with _drawing_from(self.stream):
            f.update(z, R=np.eye(len(z)))
        f.P = symmetric(f.P)
        self.nis += squared_innovation(z, f.SI)  # the turned h has mean 0
        return True


_GLOBAL_STATE = Lock()


@contextmanager
def _drawing_from(stream: np.random.BitGenerator) -> Iterator[None]:
    """Lends NumPy's global generator, which filterpy draws from, another stream, and puts back what was there."""
    shared: Any = np.random  # NumPy's stubs do not know the two functions below
    with _GLOBAL_STATE:
        generator, state = shared.get_bit_generator(), shared.get_state(legacy=False)
        shared.set_bit_generator(stream)
        try:
            yield
        finally:
            shared.set_bit_generator(generator)
            shared.set_state(state)
