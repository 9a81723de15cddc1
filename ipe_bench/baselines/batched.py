"""Filters of all trials at once: the equations that filterpy computes trial by trial, as stacked linear algebra."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from ipe_bench.baselines.epochs import Epoch, Rows, Walk, symmetric
from ipe_bench.baselines.sequential import LARGEST
from ipe_bench.basics.linalg import Array, Mask, finite, multiply, solve
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.problem import Problem


class Stack(Walk):
    """The filters of a batch, at x = 0 with covariance P0 (n, n) and process noise Q (n, n) per epoch.

    `at` are the trials that something is done for; a trial's bits do not depend on which others there are.
    """

    slopes = False
    """True where `update` wants dh/dx; then there is one point per trial."""

    def __init__(self, P0: Array, Q: Array, problem: Problem, z: Array) -> None:
        super().__init__(problem, z)
        self.x = np.zeros((len(z), len(P0)))
        """The estimates (trials, n)."""
        self.P = np.repeat(P0[None], len(z), axis=0)
        """Their covariances (trials, n, n)."""
        self.Q = Q

    def predict(self, at: Rows) -> None:
        """Brings the states from one epoch to the next: the parameters stay, the process noise comes on top."""
        self.P[at] += self.Q

    @abstractmethod
    def points(self, at: Rows) -> Array:
        """The states (trials, points, n) at which the epoch's readings are wanted; NaN where there are none."""

    @abstractmethod
    def update(self, at: Rows, z: Array, h: Array, H: Array | None) -> Mask | bool:
        """Takes in z (trials, m), given h (trials, points, m) and, for filters with slopes, dh/dx (trials, m, n).

        Returns which trials are done with the epoch; the others are read again. What cannot be computed is NaN.
        """

    def state(self, at: Rows) -> tuple[Array, Array]:
        return self.x[at], self.P[at]

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        self.predict(at)
        while len(at):
            points = self.points(at)
            lost = ~finite(points)
            self.end(at[lost], Status.SINGULAR, f"the filter's P is not positive definite at epoch {epoch.number}")
            if lost.all():
                return
            at, h, H = self.read(epoch, points[~lost], at[~lost], slopes=self.slopes)
            beyond = ~(np.abs(h if H is None else H).max(axis=(1, 2)) < LARGEST)
            self.end(at[beyond], Status.NONFINITE, "what the filter is to take in is beyond the range of numbers")
            at = at[~beyond]
            if not len(at):
                return
            done = self.update(at, epoch.whitened(self.z[at]), h[~beyond], None if H is None else H[~beyond])
            lost = ~finite(self.x[at])
            self.end(at[lost], Status.SINGULAR, f"S is singular at epoch {epoch.number}")
            at = at[~(done | lost)]

    def correct(self, at: Rows, away: Array, z: Array, h: Array, weights: Array, mean: Array) -> None:
        """The update of a filter whose points are `away` (trials, points, n) from its estimate.

        `weights` (points,) are those of covariances, `mean` (points,) those of means.
        """
        centre = h.mean(axis=1, keepdims=True)
        spread = h - centre
        axes = principal_axes(np.matmul(spread.swapaxes(1, 2), spread))
        spread, z = np.matmul(spread, axes), multiply(axes.swapaxes(1, 2), z - centre[:, 0])
        predicted = np.matmul(mean, spread)
        off = spread - predicted[:, None]
        weighted = off * weights[:, None]
        S = np.matmul(off.swapaxes(1, 2), weighted) + np.eye(z.shape[1])
        cross = np.matmul(away.swapaxes(1, 2), weighted)
        K, y = gain_of(cross, S), z - predicted
        self.x[at] += multiply(K, y)
        self.P[at] = symmetric(self.P[at] - np.matmul(K, cross.swapaxes(1, 2)))
        self.nis[at] += squared_innovations(y, S)


def principal_axes(G: Array) -> Array:
    """Orthonormal axes (trials, m, m), one per column, along which each G (trials, m, m), symmetric, is diagonal.

    White readings stay white when turned to them, and S becomes nearly diagonal: so it keeps its digits where a wide
    prior makes it as ill-conditioned as 1e10.
    """
    return np.linalg.eigh(G)[1]


def gain_of(cross: Array, S: Array) -> Array:
    """K = Pxz S^-1 (trials, n, m); NaN where S is singular."""
    return solve(S, cross.swapaxes(1, 2))[0].swapaxes(1, 2)


def squared_innovations(y: Array, S: Array) -> Array:
    """y' S^-1 y of each trial."""
    return np.einsum("ti,ti->t", y, solve(S, y)[0])
