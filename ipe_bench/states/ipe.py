"""Iterative parameter estimation of paths: eq. (11) for the start and the process noises of a state model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import ClassVar, Literal

import numpy as np

from ipe_bench.basics.linalg import Array, finite, multiply, solve
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.states.algebra import factor, lower_solve, root, transposed
from ipe_bench.states.base import StateModel
from ipe_bench.states.trackers import Tracker, Tracks

_FAR = 1e8
"""An iteration has diverged once F is this many times that of the start."""
_NUMBERS = 5e7
"""Numbers of the largest matrix of a trial, and of the slopes that are held at once."""


@dataclass(frozen=True)
class PathIPE(Tracker):
    r"""Solves eq. (11) for a whole path, its slopes frozen along the path of the prior's mean: the paper's estimator.

    The unknowns u are the start and all process noises in their own standard deviations, so that their prior is N(0, I)
    and stands as N readings of 0 beside the M readings z of the log, whose h(u) runs the model from the first epoch to
    the last. With R = I, by whitening, A = dh/du at u = 0, and B = dh/du at the iterate,

    .. math:: H^+ = (I + A^T A)^{-1} \begin{bmatrix} I & A^T \end{bmatrix}, \quad
        F(u) = H^+ \begin{bmatrix} u \\ h(u) - z \end{bmatrix}, \quad
        J_F = (I + A^T A)^{-1} (I + A^T B).

    The fixed-point iteration u <- u - F(u), eq. (17), is the smoother of that frozen model, pass by pass; Newton's,
    eq. (20), solves with J_F. Both begin at the linear estimate, eq. (16). The covariance is the sandwich at the root.
    Neither converges where the prior's mean path is far from the true one.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> table = ib.run(model, {"ipe_newton": ib.states.PathIPE(method="newton")}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    family: ClassVar[str] = "IPE"
    smooths: ClassVar[bool] = True
    method: Literal["fixed_point", "newton"] = "fixed_point"
    """The iteration: eq. (17), or eq. (20)."""
    max_iterations: Count = 100
    """Steps at most, then the trial ends as `max_iterations`."""
    tolerance: Positive = 1e-6
    """Largest abs(F_i) in standard deviations of the linear bound."""

    def hindrance(self, model: StateModel) -> str | None:
        if why := super().hindrance(model):
            return why
        N, M = sum(_widths(model)), model.m
        if N * max(M, model.n * model.epochs) > _NUMBERS:
            return f"needs a matrix of {M} readings by {N} unknowns for a path of {model.name}; give fewer epochs"
        return None

    def track(self, model: StateModel, z: Array) -> Tracks:
        out = Tracks.empty(model, len(z))
        out.cost = np.empty(len(z))
        out.status, out.iterations = (
            np.full(len(z), Status.RUNNING, np.int8),
            np.zeros(len(z), np.int64),
        )
        seen, pattern = np.unique(np.isfinite(z), axis=0, return_inverse=True)
        at_once = max(1, int(_NUMBERS / (sum(_widths(model)) * model.n * model.epochs)))
        for i, there in enumerate(seen):
            rows, frozen = np.flatnonzero(pattern.reshape(-1) == i), _Frozen.of(model, there)
            for part in np.split(rows, range(at_once, len(rows), at_once)):
                self._solve(frozen, np.where(there, z[part], 0.0), out, part)
        return out

    def _solve(self, frozen: _Frozen, z: Array, out: Tracks, rows: Array) -> None:
        """Iterates on F for readings z (trials, K, m) that are the trials `rows` of the tracks."""
        assert out.cost is not None
        assert out.status is not None
        assert out.iterations is not None
        model, n = frozen.model, frozen.model.n
        u = np.zeros((len(z), len(frozen.gain)))
        u = u - frozen.F(u, frozen.run(u, z)[1])
        x, r = frozen.run(u, z)
        out.calls[rows] += (1 + n + 3) * model.evaluations
        begun, active, singular = np.ones(len(z)), np.arange(len(z)), np.zeros(len(z), dtype=bool)
        for iteration in range(self.max_iterations + 1):
            F = frozen.F(u[active], r[active])
            size = (np.abs(F) / frozen.deviation).max(axis=1)
            begun = begun if iteration else np.maximum(size, 1.0)
            endings = (
                (singular[active], Status.SINGULAR),
                (~np.isfinite(size), Status.NONFINITE),
                (size <= self.tolerance, Status.CONVERGED),
                (size > _FAR * begun[active], Status.DIVERGED),
                (np.full(len(size), iteration == self.max_iterations), Status.MAX_ITERATIONS),
            )
            now = np.select(*zip(*endings, strict=True), Status.RUNNING)  # type: ignore[arg-type]
            out.status[rows[active]], out.iterations[rows[active]] = now, iteration
            F, active = F[now == Status.RUNNING], active[now == Status.RUNNING]
            if not len(active):
                break
            if self.method == "newton":
                B = frozen.slopes(x[active])[1]
                F, singular[active] = frozen.divided(F, B)
                out.calls[rows[active]] += (1 + n) * model.evaluations
            u[active] -= F
            x[active], r[active] = frozen.run(u[active], z[active])
            out.calls[rows[active]] += model.evaluations
        out.cost[rows] = np.sum(u**2, axis=1) + np.sum(r**2, axis=1)
        P = np.full((len(z), model.epochs + 1, n, n), np.nan)
        if (usable := finite(x) & finite(u)).any():
            P[usable] = frozen.sandwich(*frozen.slopes(x[usable]))
            out.calls[rows[usable]] += (1 + n) * model.evaluations
        out.mean[rows], out.covariance[rows] = x[:, 1:], P[:, 1:]
        out.start.mean[rows], out.start.covariance[rows] = x[:, 0], P[:, 0]


def _widths(model: StateModel) -> list[int]:
    """The numbers of unknowns of the start and of each step."""
    steps = [model.gain(k).shape[1] for k in range(model.epochs) if model.moves(k)]
    return [root(model.prior.covariance).shape[1], *steps]


@dataclass(frozen=True)
class _Frozen:
    """Holds the system of eq. (11) for the path of a model, of whose K m readings those of `seen` are there."""

    model: StateModel
    gains: list[Array]
    """Root of the prior's covariance, and the gain of the step into each epoch: (n, 0) if none leads there."""
    seen: Array
    """(K, m)"""
    whitening: Array
    """L^-1 (K, m, m) of the covariances L L' of the readings of each epoch."""
    A: Array
    """dh/du (M, N) at u = 0, whitened; 0 for missing readings."""
    gain: Array
    """A' (I + A A')^-1 (N, M)."""

    @classmethod
    def of(cls, model: StateModel, seen: Array) -> _Frozen:
        K, n, m = model.epochs, model.n, model.readings_per_epoch
        steps = (model.gain(k) if model.moves(k) else np.empty((n, 0)) for k in range(K))
        both = seen[:, :, None] & seen[:, None, :]
        R = np.where(both, [model.R(k) for k in range(K)], np.eye(m))
        whitening = lower_solve(factor(R), np.eye(m))
        gains, none = [root(model.prior.covariance), *steps], np.empty(0)
        start = cls(model, gains, seen, whitening, none, none)
        still = np.zeros((1, sum(G.shape[1] for G in gains)))
        x, _ = start.run(still, np.zeros((1, *seen.shape)))
        A = start.slopes(x)[1][0]
        gain = np.linalg.solve(np.eye(len(A)) + A @ A.T, A).T
        return cls(model, gains, seen, whitening, A, gain)

    @cached_property
    def unknowns(self) -> list[slice]:
        """The places in u of the start and of the noise of each step."""
        ends = np.cumsum([G.shape[1] for G in self.gains]).tolist()
        return [slice(*ends_of) for ends_of in zip([0, *ends], ends, strict=False)]

    @cached_property
    def inverse(self) -> Array:
        """H+ (N, N + M) = [(I + A' A)^-1, gain]."""
        return np.concatenate([np.eye(len(self.gain)) - self.gain @ self.A, self.gain], axis=1)

    @cached_property
    def deviation(self) -> Array:
        """Standard deviations (N,) of the linear estimate, eq. (5)."""
        return np.sqrt(1.0 - np.sum(self.gain * self.A.T, axis=1))

    def run(self, u: Array, z: Array) -> tuple[Array, Array]:
        """The states x (trials, 1 + K, n) of u (trials, N), and h(u) - z (trials, M), whitened."""
        model = self.model
        x = np.empty((len(u), model.epochs + 1, model.n))
        x[:, 0] = model.prior.mean
        for k, (G, own) in enumerate(zip(self.gains, self.unknowns, strict=True), -1):
            if k >= 0:
                x[:, k + 1] = model.transition_into(k)(x[:, k]) if model.moves(k) else x[:, k]
            x[:, k + 1] += multiply(G, u[:, own])
        h = model.epoch_functions[1].values(x[:, 1:])
        e = np.where(self.seen, model.nearest(h, z) - z, 0.0)
        return x, multiply(self.whitening, e).reshape(len(u), -1)

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """df/dx (trials, K, n, n) along the states x (trials, 1 + K, n), and dh/du (trials, M, N), whitened."""
        along = self.model.slopes_along(x)
        N = self.unknowns[-1].stop
        one = np.broadcast_to(np.eye(N), (len(x), N, N))
        H = np.matmul(self.whitening, np.where(self.seen[..., None], along.H, 0.0))
        B = [
            np.matmul(H[:, k], X) for k, X in enumerate(islice(self._moved(along.F, one), 1, None))
        ]
        return along.F, np.concatenate(B, axis=1)

    def _moved(self, F: Array, D: Array) -> Iterator[Array]:
        """Yields what a change D (trials, N, p) of u changes of the start and of the states at each epoch (trials, n,
        p), by the slopes F of the transitions."""
        X = np.matmul(self.gains[0], D[:, self.unknowns[0]])
        yield X
        for k, (G, own) in enumerate(zip(self.gains[1:], self.unknowns[1:], strict=True)):
            X = np.matmul(F[:, k], X) + np.matmul(G, D[:, own])
            yield X

    def F(self, u: Array, r: Array) -> Array:
        """Eq. (11): H+ (h - z) (trials, N), in which (I + A' A)^-1 A' is the gain and (I + A' A)^-1 = I - gain A."""
        return u - multiply(self.gain, multiply(self.A, u) - r)

    def divided(self, F: Array, B: Array) -> tuple[Array, Array]:
        """J_F^-1 F (trials, N), J_F = I + (I + A' A)^-1 A' (B - A), by M equations in place of N (Woodbury), and
        whether there is none."""
        C = B - self.A
        w, singular = solve(np.eye(len(self.A)) + np.matmul(C, self.gain), multiply(C, F))
        return F - multiply(self.gain, w), singular & finite(F)

    def sandwich(self, F: Array, B: Array) -> Array:
        """The covariances (trials, 1 + K, n, n) of the states at the root: T T' with T = X J_F^-1 H+ and X = dx/du,
        which moves from epoch to epoch as states do."""
        C = B - self.A
        W, _ = solve(np.eye(len(self.A)) + np.matmul(C, self.gain), np.matmul(C, self.inverse))
        moved = self._moved(F, self.inverse - np.matmul(self.gain, W))
        return np.stack([np.matmul(T, transposed(T)) for T in moved], axis=1)
