"""The ensemble Kalman filter, filterpy's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt

from ipe_bench.baselines.batched import TurnedReadings
from ipe_bench.baselines.epochs import Epoch, Rows, Walk, symmetric
from ipe_bench.baselines.sequential import Sequential, Track, in_turn, squared_innovation, turned
from ipe_bench.basics.linalg import Array, finite, multiply, solve
from ipe_bench.basics.options import Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.basics.streams import own_bits
from ipe_bench.measurements.problem import Problem


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

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> EnKFStack:
        return EnKFStack(P0, Q, problem, z, self)


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


class EnKFStack(Walk):
    """The same filter for all trials at once, with the same draws."""

    def __init__(self, P0: Array, Q: Array, problem: Problem, z: Array, given: EnKF) -> None:
        super().__init__(problem, z)
        self.x, self.P = np.zeros((len(z), len(P0))), np.repeat(P0[None], len(z), axis=0)
        self.members, self.draws = given.members, [np.random.RandomState(own_bits(given.seed, row)) for row in z]
        self.root_Q = _root(Q)
        self.ensemble = self._drawn(np.arange(len(z)), _root(P0))

    def _drawn(self, at: Rows, root: Array) -> Array:
        """Gaussian draws (trials, members, size) of covariance root' root, from each trial's own stream."""
        white = [self.draws[trial].standard_normal((self.members, len(root))) for trial in at]
        return np.matmul(np.stack(white), root) if white else np.empty((0, self.members, len(root)))

    def state(self, at: Rows) -> tuple[Array, Array]:
        return self.x[at], self.P[at]

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        self.ensemble[at] += self._drawn(at, self.root_Q)
        h = TurnedReadings(self, epoch, at, self.P[at]).read(self.ensemble[at], slopes=False)[0]
        at, h = at[finite(h)], h[finite(h)]
        z = epoch.whitened(self.z[at])
        self.x[at] = self.ensemble[at].mean(axis=1)
        away = self.ensemble[at] - self.x[at][:, None]
        self.P[at] = np.matmul(away.swapaxes(1, 2), away) / (self.members - 1)
        centre = h.mean(axis=1, keepdims=True)
        spread = h - centre
        # The perturbations are drawn along these axes, so they are those of `turned` to the sign.
        axes = np.linalg.svd(spread, full_matrices=h.shape[1] < h.shape[2])[2].swapaxes(1, 2)
        spread, z = np.matmul(spread, axes), multiply(axes.swapaxes(1, 2), z - centre[:, 0])
        off = spread - spread.mean(axis=1, keepdims=True)
        I = np.eye(z.shape[1])  # noqa: E741  the field's letter for the unit matrix
        S = np.matmul(off.swapaxes(1, 2), off) / (self.members - 1) + I
        K = solve(S, np.matmul(off.swapaxes(1, 2), away) / (self.members - 1))[0].swapaxes(1, 2)
        innovations = z[:, None] + self._drawn(at, _root(I)) - spread
        self.ensemble[at] += np.matmul(innovations, K.swapaxes(1, 2))
        self.x[at] = self.ensemble[at].mean(axis=1)
        self.P[at] = symmetric(self.P[at] - np.matmul(np.matmul(K, S), K.swapaxes(1, 2)))
        self.nis[at] += np.einsum("ti,ti->t", z, solve(S, z)[0])
        self.end(at[~finite(self.x[at])], Status.SINGULAR, f"S is singular at epoch {epoch.number}")


def _root(P: Array) -> Array:
    """The root of P by which NumPy's `multivariate_normal` turns white draws into draws of covariance P."""
    _, s, v = np.linalg.svd(P)
    return np.sqrt(s)[:, None] * v


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
