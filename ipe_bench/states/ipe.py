"""Iterative parameter estimation of paths: eq. (11) for the start and the process noises of a state
model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, pairwise
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask, finite, multiply, solve
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.states.algebra import factor, lower_solve, root, transposed
from ipe_bench.states.base import StateModel
from ipe_bench.states.trackers import Tracker, Tracks

_FAR = 1e8
"""An iteration has diverged once F is this many times that of the start."""
_LOST = 3e13
"""Standard deviation of what is read, in those of its reading, of which no digits are left."""
_NUMBERS = 2e7
"""Numbers of the largest matrix of a trial at most, which takes a gigabyte with what is made of
it."""
_AT_ONCE = 1e6
"""Numbers of the slopes of trials that are held at once, unless one trial has more."""


@dataclass(frozen=True)
class PathIPE(Tracker):
    r"""Solves eq. (11) for a whole path, its slopes frozen along the path of the prior's mean: the
    paper's estimator.

    The unknowns u are the start and all process noises in their own standard deviations, so that
    their prior is N(0, I) and stands as N readings of 0 beside the M readings z of the log, whose
    h(u) runs the model from the first epoch to the last. With R = I, by whitening, A = dh/du at u =
    0, and B = dh/du at the iterate,

    .. math:: H^+ = (I + A^T A)^{-1} \begin{bmatrix} I & A^T \end{bmatrix}, \quad
        F(u) = H^+ \begin{bmatrix} u \\ h(u) - z \end{bmatrix}, \quad
        J_F = (I + A^T A)^{-1} (I + A^T B).

    The fixed-point iteration u <- u - F(u), eq. (17), is the smoother of that frozen model, pass by
    pass; Newton's, eq. (20), solves with J_F. Both begin at the linear estimate, eq. (16). The
    covariance is the sandwich at the root. Neither converges where the prior's mean path is far
    from the true one.

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
        why = super().hindrance(model)
        if why:
            return why
        N = sum(_widths(model))
        if not N:
            return f"has no unknowns: every state of {model.name} is known exactly; leave it out"
        if N * max(model.m, model.n * model.epochs) > _NUMBERS:
            return (
                f"takes more than a gigabyte for the {N} unknowns of a path of {model.name}; "
                "give fewer epochs, or take lm_ieks"
            )
        return None

    def track(self, model: StateModel, z: Array) -> Tracks:
        trials = len(z)
        out = Tracks.empty(model, trials)
        out.cost = np.empty(trials)
        out.status = np.empty(trials, np.int8)
        out.iterations = np.empty(trials, np.int64)
        # Trials in which the same readings are missing have the same frozen system.
        seen, pattern = np.unique(np.isfinite(z), axis=0, return_inverse=True)
        at_once = max(1, int(_AT_ONCE / (sum(_widths(model)) * model.n * model.epochs)))
        for i, there in enumerate(seen):
            frozen = _Frozen.of(model, there)
            alike = np.flatnonzero(pattern.reshape(-1) == i)
            for rows in np.split(alike, range(at_once, len(alike), at_once)):
                at = self._iterated(frozen, np.where(there, z[rows], 0.0))
                P = frozen.covariances(at)
                out.mean[rows] = at.x[:, 1:]
                out.covariance[rows] = P[:, 1:]
                out.start.mean[rows] = at.x[:, 0]
                out.start.covariance[rows] = P[:, 0]
                out.cost[rows] = np.sum(at.u**2, axis=1) + np.sum(at.r**2, axis=1)
                out.status[rows] = at.status
                out.iterations[rows] = at.iterations
                out.calls[rows] = at.calls
        return out

    def _iterated(self, frozen: _Frozen, z: Array) -> _Iterates:
        """Iterates on F for readings z (trials, K, m), until every trial has ended."""
        model = frozen.model
        at = frozen.linear_estimate(z)
        first_size = np.ones(len(z))
        active = np.arange(len(z))
        for iteration in range(self.max_iterations + 1):
            F = frozen.F(at.u[active], at.r[active])
            size = (np.abs(F) / frozen.deviation).max(axis=1)
            if iteration == 0:
                first_size = np.maximum(size, 1.0)
            last = iteration == self.max_iterations
            # The first that holds is how a trial ends.
            endings = {
                Status.SINGULAR: at.singular[active],
                Status.NONFINITE: ~np.isfinite(size),
                Status.CONVERGED: size <= self.tolerance,
                Status.DIVERGED: size > _FAR * first_size[active],
                Status.MAX_ITERATIONS: np.full(len(size), last),
            }
            status = np.select([*endings.values()], [*endings], Status.RUNNING)
            at.status[active] = status
            at.iterations[active] = iteration
            going = status == Status.RUNNING
            active = active[going]
            if not len(active):
                break
            # Eq. (17): u <- u - F(u);  eq. (20): u <- u - J_F^-1 F(u)
            step = F[going]
            if self.method == "newton":
                B = frozen.slopes(at.x[active])[1]
                step, at.singular[active] = frozen.divided(step, B)
                at.calls[active] += (1 + model.n) * model.evaluations
            at.u[active] -= step
            at.x[active], at.r[active] = frozen.run(at.u[active], z[active])
            at.calls[active] += model.evaluations
        return at


@dataclass
class _Iterates:
    """Holds where the iterations of a batch stand."""

    u: Array
    """(trials, N)"""
    x: Array
    """The states (trials, 1 + K, n) of u."""
    r: Array
    """h(u) - z (trials, M), whitened."""
    calls: Array
    """Evaluations of f and of h (trials,)."""
    singular: Mask
    """Whether J_F had no inverse (trials,)."""
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]


def _widths(model: StateModel) -> list[int]:
    """Counts the unknowns of the start and of each step."""
    steps = [model.gain(k).shape[1] for k in range(model.epochs) if model.moves(k)]
    return [root(model.prior.covariance).shape[1], *steps]


@dataclass(frozen=True)
class _Frozen:
    """Holds the system of eq. (11) for the path of a model, of whose K m readings those of `seen`
    are there."""

    model: StateModel
    gains: list[Array]
    """Root of the prior's covariance, and the gain of the step into each epoch: (n, 0) if none
    leads there."""
    seen: Array
    """(K, m)"""
    whitening: Array
    """L^-1 (K, m, m) of the covariances L L' of the readings of each epoch."""
    A: Array
    """dh/du (M, N) at u = 0, whitened; 0 for missing readings."""
    Q: Array
    """Orthonormal columns (N + M, N) of (I; A) = Q T with a triangular T: with Q = (Q1; Q2), it is
    (I + A' A)^-1 = Q1 Q1' and (I + A' A)^-1 A' = Q1 Q2', and nothing is squared."""

    @classmethod
    def of(cls, model: StateModel, seen: Array) -> _Frozen:
        m = model.readings_per_epoch
        epochs = range(model.epochs)
        still = np.empty((model.n, 0))
        steps = [model.gain(k) if model.moves(k) else still for k in epochs]
        gains = [root(model.prior.covariance), *steps]
        # A missing reading has unit variance, and no slope.
        both = seen[:, :, None] & seen[:, None, :]
        R = np.where(both, [model.R(k) for k in epochs], np.eye(m))
        whitening = lower_solve(factor(R), np.eye(m))
        none = np.empty(0)
        start = cls(model, gains, seen, whitening, none, none)
        # A = dh/du at u = 0, the path of the prior's mean.
        u = np.zeros((1, start.unknowns[-1].stop))
        x, _ = start.run(u, np.zeros((1, *seen.shape)))
        A = start.slopes(x)[1][0]
        Q = np.linalg.qr(np.concatenate([np.eye(A.shape[1]), A]))[0]
        if np.linalg.norm(A, axis=1).max() > _LOST:
            Q[:] = np.nan
        return replace(start, A=A, Q=Q)

    @cached_property
    def unknowns(self) -> list[slice]:
        """The places in u of the start and of the noise of each step."""
        ends = np.cumsum([G.shape[1] for G in self.gains]).tolist()
        return [slice(first, end) for first, end in pairwise([0, *ends])]

    @cached_property
    def gain(self) -> Array:
        """(I + A' A)^-1 A' (N, M)."""
        N = self.Q.shape[1]
        return self.inverse[:, N:]

    @cached_property
    def inverse(self) -> Array:
        """H+ (N, N + M) = [(I + A' A)^-1, gain]."""
        N = self.Q.shape[1]
        return self.Q[:N] @ self.Q.T

    @cached_property
    def deviation(self) -> Array:
        """Standard deviations (N,) of the linear estimate, eq. (5)."""
        N = self.Q.shape[1]
        return np.linalg.norm(self.Q[:N], axis=1)

    def run(self, u: Array, z: Array) -> tuple[Array, Array]:
        """Computes the states x (trials, 1 + K, n) of u (trials, N), and h(u) - z (trials, M),
        whitened."""
        model = self.model
        x = np.empty((len(u), model.epochs + 1, model.n))
        # x_0 = m_0 + P_0^1/2 u_0
        x[:, 0] = model.prior.mean + multiply(self.gains[0], u[:, self.unknowns[0]])
        for k in range(model.epochs):
            # x_k = f(x_k-1) + G_k u_k
            moved = model.transition_into(k)(x[:, k]) if model.moves(k) else x[:, k]
            noise = multiply(self.gains[k + 1], u[:, self.unknowns[k + 1]])
            x[:, k + 1] = moved + noise
        h = model.epoch_functions[1].values(x[:, 1:])
        e = np.where(self.seen, model.nearest(h, z) - z, 0.0)
        return x, multiply(self.whitening, e).reshape(len(u), -1)

    def linear_estimate(self, z: Array) -> _Iterates:
        """Takes the first step, eq. (16), from u = 0, for readings z (trials, K, m)."""
        trials = len(z)
        u = np.zeros((trials, len(self.gain)))
        u = u - self.F(u, self.run(u, z)[1])
        x, r = self.run(u, z)
        # The slopes at u = 0 and that path are evaluated once, but would be for a trial alone.
        calls = np.full(trials, (1.0 + self.model.n + 3) * self.model.evaluations)
        singular = np.zeros(trials, dtype=bool)
        status = np.full(trials, Status.RUNNING, np.int8)
        return _Iterates(u, x, r, calls, singular, status, np.zeros(trials, np.int64))

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Computes df/dx (trials, K, n, n) along the states x (trials, 1 + K, n), and dh/du
        (trials, M, N), whitened."""
        along = self.model.slopes_along(x)
        H = np.matmul(self.whitening, np.where(self.seen[..., None], along.H, 0.0))
        N = self.unknowns[-1].stop
        one = np.broadcast_to(np.eye(N), (len(x), N, N))
        # dh_k/du = H_k dx_k/du; nothing is read of the start.
        X = islice(self._moved(along.F, one), 1, None)
        B = [np.matmul(H[:, k], X_k) for k, X_k in enumerate(X)]
        return along.F, np.concatenate(B, axis=1)

    def _moved(self, F: Array, D: Array) -> Iterator[Array]:
        """Yields what a change D (trials, N, p) of u changes of the start and of the states at each
        epoch (trials, n, p), by the slopes F of the transitions."""
        X = np.matmul(self.gains[0], D[:, self.unknowns[0]])
        yield X
        for k in range(self.model.epochs):
            # dx_k = F_k dx_k-1 + G_k du_k
            noise = np.matmul(self.gains[k + 1], D[:, self.unknowns[k + 1]])
            X = np.matmul(F[:, k], X) + noise
            yield X

    def F(self, u: Array, r: Array) -> Array:
        """Computes eq. (11), H+ (h - z) (trials, N), for h - z = (u; r)."""
        return multiply(self.inverse, np.concatenate([u, r], axis=1))

    def divided(self, F: Array, B: Array) -> tuple[Array, Array]:
        """Computes J_F^-1 F (trials, N), J_F = I + (I + A' A)^-1 A' (B - A), by M equations in
        place of N (Woodbury), and whether there is none."""
        C, core = self._changed(B)
        w, singular = solve(core, multiply(C, F))
        return F - multiply(self.gain, w), singular & finite(F)

    def _changed(self, B: Array) -> tuple[Array, Array]:
        """Computes C = B - A (trials, M, N) and I + C gain (trials, M, M): J_F = I + gain C, and by
        Woodbury's formula J_F^-1 = I - gain (I + C gain)^-1 C."""
        C = B - self.A
        return C, np.eye(len(self.A)) + np.matmul(C, self.gain)

    def covariances(self, at: _Iterates) -> Array:
        """Computes the covariances (trials, 1 + K, n, n) of the states of iterates; NaN of those
        that are not finite."""
        n = self.model.n
        P = np.full((*at.x.shape, n), np.nan)
        usable = finite(at.x) & finite(at.u)
        if usable.any():
            P[usable] = self.sandwich(*self.slopes(at.x[usable]))
            at.calls[usable] += (1 + n) * self.model.evaluations
        return P

    def sandwich(self, F: Array, B: Array) -> Array:
        """Computes the covariances (trials, 1 + K, n, n) of the states at the root: T T' with T = X
        J_F^-1 H+ and X = dx/du, which moves from epoch to epoch as states do."""
        C, core = self._changed(B)
        W, _ = solve(core, np.matmul(C, self.inverse))
        moved = self._moved(F, self.inverse - np.matmul(self.gain, W))
        return np.stack([np.matmul(T, transposed(T)) for T in moved], axis=1)
