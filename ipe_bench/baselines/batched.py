"""Filters of all trials at once: the equations that filterpy computes trial by trial, as stacked linear algebra.

A filter says what an update is (`Stack`); the walk through the epochs, the counting and the failures are here. What is
wanted of a filter, and filterpy itself, is left to `sequential`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.baselines.epochs import Epoch
from ipe_bench.basics.linalg import Array, Mask, finite, multiply, solve
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem

Rows = NDArray[np.intp]
_LARGEST = 1e150
"""What a filter is given must have squares."""


class Stack(ABC):
    """The filters of a batch. States are distances from the nominal point in prior deviations, readings are white.

    `at` are the trials that something is done for; a trial's bits do not depend on which others there are.
    """

    def __init__(self, P0: Array, Q: Array, trials: int) -> None:
        self.x = np.zeros((trials, len(P0)))
        """The estimates (trials, n)."""
        self.P = np.repeat(P0[None], trials, axis=0)
        """Their covariances (trials, n, n)."""
        self.Q = Q
        self.nis = np.zeros(trials)
        """The squared innovations y' S^-1 y, summed over the epochs so far."""

    def predict(self, at: Rows) -> None:
        """Brings the states from one epoch to the next: the parameters stay, the process noise comes on top."""
        self.P[at] += self.Q

    @abstractmethod
    def points(self, at: Rows) -> Array:
        """The states (trials, points, n) at which the epoch's readings are wanted; NaN where there are none."""

    @abstractmethod
    def update(self, at: Rows, z: Array, h: Array, H: Array | None) -> Mask:
        """Takes in z (trials, m), given h (trials, points, m) and, for filters with slopes, dh/dx (trials, m, n).

        Returns which trials are done with the epoch; the others are read again. What cannot be computed is NaN.
        """


def run(stack: Stack, problem: Problem, z: Array, epochs: Sequence[Epoch], *, slopes: bool, history: bool) -> Estimates:
    """Takes the readings z (trials, m) in, epoch by epoch."""
    return _Walk(stack, problem, z, slopes=slopes).estimates(epochs, history=history)


class _Walk:
    def __init__(self, stack: Stack, problem: Problem, z: Array, *, slopes: bool) -> None:
        self.stack, self.problem, self.z, self.slopes = stack, problem, z, slopes
        self.d = np.asarray(problem.prior_deviation, dtype=float)
        self.tally = EvaluationCount.zeros(len(z))
        self.status = np.full(len(z), Status.RUNNING, dtype=np.int8)
        self.messages: dict[int, str] = {}
        self.taken = np.zeros(len(z), dtype=np.int64)
        self.iterates = [np.zeros_like(stack.x)]
        for trial in np.flatnonzero(~finite(z)):
            row = int(np.flatnonzero(~np.isfinite(z[trial]))[0])
            self.end([trial], Status.NONFINITE, f"reading {row + 1} is not a finite number")

    @property
    def going(self) -> Rows:
        return np.flatnonzero(self.status == Status.RUNNING)

    def end(self, trials: Any, status: Status, message: str) -> None:
        for trial in trials:
            self.status[trial] = status
            self.messages[int(trial)] = message

    def estimates(self, epochs: Sequence[Epoch], *, history: bool) -> Estimates:
        last = self.iterates[0].copy()
        for epoch in epochs:
            self.stack.predict(self.going)
            waiting = self.going
            while len(waiting):
                waiting = self.advance(epoch, waiting)
            going = self.going
            last[going] = self.stack.x[going]
            self.taken[going] += 1
            self.iterates.append(last.copy() if history else last)
            overflowed = ~(finite(self.stack.x[going]) & finite(self.stack.P[going]))
            self.end(going[overflowed], Status.NONFINITE, f"the filter's state overflowed at epoch {epoch.number}")
        self.status[self.going] = Status.CONVERGED
        return self.collect(last, history=history)

    def advance(self, epoch: Epoch, at: Rows) -> Rows:
        """Reads the model at the points of the trials and takes the readings in; returns who is read again."""
        points = self.stack.points(at)
        lost = ~finite(points)
        self.end(at[lost], Status.SINGULAR, f"the filter's P is not positive definite at epoch {epoch.number}")
        at, points = at[~lost], points[~lost]
        if not len(at):
            return at
        h, H = epoch.read(self.problem.x0 + points * self.d, at, self.tally, slopes=self.slopes)
        H = None if H is None else H * self.d
        raised = self.tally.failed(at)
        for trial in at[raised]:
            self.end([trial], Status.ERROR, self.tally.messages[int(trial)])
        overflowed = ~raised & ~(finite(h) & (True if H is None else finite(H)))
        self.end(at[overflowed], Status.NONFINITE, f"the model overflowed at epoch {epoch.number}")
        large = np.abs(h).max(axis=(1, 2)) if H is None else np.abs(H).max(axis=(1, 2))
        beyond = ~raised & ~overflowed & ~(large < _LARGEST)
        self.end(at[beyond], Status.NONFINITE, "what the filter is to take in is beyond the range of numbers")
        kept = ~(raised | overflowed | beyond)
        at = at[kept]
        if not len(at):
            return at
        z = epoch.whitened(self.z[at])
        done = self.stack.update(at, z, h[kept], None if H is None else H[kept])
        lost = ~finite(self.stack.x[at])
        self.end(at[lost], Status.SINGULAR, f"S is singular at epoch {epoch.number}")
        return at[~done & ~lost]

    def collect(self, last: Array, *, history: bool) -> Estimates:
        finished = self.status == Status.CONVERGED
        P = self.stack.P * self.d * self.d[:, None]
        covariance = np.where(finished[:, None, None], symmetric(P), np.nan)
        iterates = None
        if history:
            x = self.problem.x0 + np.stack(self.iterates, axis=1) * self.d
            iterates = [rows[: count + 1] for rows, count in zip(x, self.taken, strict=True)]
        return Estimates(
            x=self.problem.x0 + last * self.d,
            status=self.status,
            covariance=covariance,
            iterations=self.taken,
            simulations=self.tally.simulations,
            jacobians=self.tally.jacobians,
            messages=self.messages,
            history=iterates,
            extras={"nis": np.where(finished, self.stack.nis / self.z.shape[1], np.nan)},
        )


def symmetric(P: Array) -> Array:
    """(P + P') / 2 of each trial."""
    return (P + P.swapaxes(-1, -2)) / 2


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


def correct(stack: Stack, at: Rows, deviations: Array, z: Array, h: Array, weights: Array, mean: Array) -> None:
    """The update of a filter whose points deviate by `deviations` (trials, points, n) from its estimate.

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
    cross = np.matmul(deviations.swapaxes(1, 2), weighted)
    K, y = gain_of(cross, S), z - predicted
    stack.x[at] += multiply(K, y)
    stack.P[at] = symmetric(stack.P[at] - np.matmul(K, cross.swapaxes(1, 2)))
    stack.nis[at] += squared_innovations(y, S)
