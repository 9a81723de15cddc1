"""Filters of all trials at once: the equations that filterpy computes trial by trial, as stacked linear algebra."""

from __future__ import annotations

import numpy as np

from ipe_bench.baselines.epochs import Epoch, Rows, Walk
from ipe_bench.baselines.sequential import LARGEST
from ipe_bench.basics.linalg import Array, deviations, finite, multiply
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.problem import Problem
from ipe_bench.states.base import Gaussian
from ipe_bench.states.linearisation import Rule
from ipe_bench.states.trackers import update


class Stack(Walk):
    """The filters of a batch, at x = 0 with covariance P0 (n, n) and process noise Q (n, n) per epoch: those of states
    that stand still.

    `at` are the trials that something is done for; a trial's bits do not depend on which others there are.
    """

    def __init__(
        self, rule: Rule, P0: Array, Q: Array, problem: Problem, z: Array, iterations: int = 1, tolerance: float = 0.0
    ) -> None:
        super().__init__(problem, z)
        self.rule, self.iterations, self.tolerance = rule, iterations, tolerance
        self.x = np.zeros((len(z), len(P0)))
        """The estimates (trials, n)."""
        self.P = np.repeat(P0[None], len(z), axis=0)
        """Their covariances (trials, n, n)."""
        self.Q = Q

    def state(self, at: Rows) -> tuple[Array, Array]:
        return self.x[at], self.P[at]

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        self.P[at] += self.Q
        x, P = self.x.copy(), self.P.copy()
        for iteration in range(self.iterations):
            before = self.x[at]
            readings = TurnedReadings(self, epoch, at, P[at])
            read = self.rule.linearise(readings, before, self.P[at])
            found = update(Gaussian(x[at], P[at]), read, np.eye(read.b.shape[-1]), readings.z)
            self.x[at], self.P[at] = found.x
            if iteration == 0:
                self.nis[at] += found.nis  # the innovation of the prediction; later ones have seen z
            lost = ~finite(found.x.mean)
            singular = lost & (self.status[at] == Status.RUNNING)
            self.end(at[singular], Status.SINGULAR, f"S is singular at epoch {epoch.number}")
            change = (np.abs(self.x[at] - before) / deviations(self.P[at])).max(axis=1)
            at = at[~(lost | (change <= self.tolerance))]
            if not len(at):
                return


class TurnedReadings:
    """An epoch's whitened readings as functions of the states of the trials `at`, along axes that make S nearly
    diagonal: white readings stay white, and S keeps its digits where a wide prior makes it as ill-conditioned as 1e10.

    Trials that the model ends are NaN.
    """

    def __init__(self, walk: Walk, epoch: Epoch, at: Rows, P: Array) -> None:
        self.walk, self.epoch, self.at, self.P = walk, epoch, at, P
        self.z = epoch.whitened(walk.z[at])

    def __call__(self, x: Array) -> Array:
        """h (trials, points, m) less its mean over the points, and z alike."""
        h, _ = self.read(x, slopes=False)
        centre = h.mean(axis=1, keepdims=True)
        spread = h - centre
        axes = principal_axes(np.matmul(spread.swapaxes(1, 2), spread))
        self.z = multiply(axes.swapaxes(1, 2), self.z - centre[:, 0])
        return np.matmul(spread, axes)

    def slope(self, x: Array) -> tuple[Array, Array]:
        """h (trials, m) and dh/dx (trials, m, n)."""
        h, H = self.read(x[:, None], slopes=True)
        axes = principal_axes(np.matmul(np.matmul(H, self.P), H.swapaxes(1, 2))).swapaxes(1, 2)
        self.z = multiply(axes, self.z)
        return multiply(axes, h[:, 0]), np.matmul(axes, H)

    def read(self, x: Array, *, slopes: bool) -> tuple[Array, Array]:
        """h (trials, points, m) as it is and, for one point, dh/dx (trials, m, n)."""
        known, m = finite(x), self.z.shape[1]
        lost = f"the filter's P is not positive definite at epoch {self.epoch.number}"
        self.walk.end(self.at[~known], Status.SINGULAR, lost)
        kept, h, H = self.walk.read(self.epoch, x[known], self.at[known], slopes=slopes)
        beyond = ~(np.abs(h if H is None else H).max(axis=(1, 2), initial=0) < LARGEST)
        self.walk.end(kept[beyond], Status.NONFINITE, "what the filter is to take in is beyond the range of numbers")
        rows = np.isin(self.at, kept[~beyond])
        values, tangents = np.full((*x.shape[:2], m), np.nan), np.full((len(x), m, x.shape[2]), np.nan)
        values[rows] = h[~beyond]
        if H is not None:
            tangents[rows] = H[~beyond]
        return values, tangents


def principal_axes(G: Array) -> Array:
    """Orthonormal axes (trials, m, m), one per column, along which each G (trials, m, m), symmetric, is diagonal."""
    return np.linalg.eigh(np.nan_to_num(G))[1]
