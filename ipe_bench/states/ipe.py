"""Iterative parameter estimation of paths: eq. (11) for the start and the process noises of a state
model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask, finite, multiply, solve
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.states.algebra import factor, lower_solve, root, transposed
from ipe_bench.states.base import StateModel
from ipe_bench.states.passes import kept_of
from ipe_bench.states.trackers import Tracker, Tracks

_FAR = 1e8
"""An iteration has diverged once F is this many times that of the start."""
_LOST = 3e13
"""Standard deviation of what is read, in those of its reading, of which no digits are left."""
_NUMBERS = 2e7
"""Numbers of the largest matrix of a trial at most, which takes a gigabyte with what is made of
it."""
_AT_ONCE = 2e6
"""Numbers of the largest matrices of trials that are held at once, unless one trial has more."""


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
        for i, there in enumerate(seen):
            frozen = _Frozen.kept(model, there)
            rows = np.flatnonzero(pattern.reshape(-1) == i)
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
                step, at.singular[active] = frozen.divided(step, at.x[active])
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


class _Slopes(NamedTuple):
    """Holds slopes along paths."""

    F: Array
    """df/dx (..., K, n, n)."""
    H: Array
    """dh/dx (..., K, m, n), whitened; 0 for missing readings."""


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
    slopes: _Slopes
    """Along the path of the prior's mean."""
    Q: Array
    """Orthonormal columns (N + M, N) of (I; A) = Q T with a triangular T: with Q = (Q1; Q2), it is
    (I + A' A)^-1 = Q1 Q1' and (I + A' A)^-1 A' = Q1 Q2', and nothing is squared."""

    @classmethod
    def kept(cls, model: StateModel, seen: Array) -> _Frozen:
        """Returns the system of these readings, which the model keeps for its next trials unless it
        is large."""
        kept = kept_of(model)
        last = kept.get("frozen")
        if last is not None and np.array_equal(last.seen, seen):
            return last
        found = cls.of(model, seen)
        if found.Q.size <= _AT_ONCE:
            kept["frozen"] = found
        return found

    @classmethod
    def of(cls, model: StateModel, seen: Array) -> _Frozen:
        m = model.readings_per_epoch
        epochs = range(model.epochs)
        still = np.empty((model.n, 0))
        steps = [model.gain(k) if model.moves(k) else still for k in epochs]
        gains = [root(model.prior.covariance), *steps]
        # A missing reading has unit variance, and no slope.
        both = seen[:, :, None] & seen[:, None, :]
        R = np.where(both, kept_of(model).parts.covariances, np.eye(m))
        whitening = lower_solve(factor(R), np.eye(m))
        none = np.empty(0)
        start = cls(model, gains, seen, whitening, _Slopes(none, none), none)
        # A = dh/du at u = 0, the path of the prior's mean.
        N = start.unknowns[-1].stop
        x, _ = start.run(np.zeros((1, N)), np.zeros((1, *seen.shape)))
        slopes = _Slopes(*(part[0] for part in start.slopes_along(x)))
        one = np.eye(N)
        X = start._moved(slopes.F, one)
        A = np.matmul(slopes.H, X[1:]).reshape(-1, N)
        Q = np.linalg.qr(np.concatenate([one, A]))[0]
        if np.linalg.norm(A, axis=1).max() > _LOST:
            Q[:] = np.nan
        return replace(start, slopes=slopes, Q=Q)

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

    def slopes_along(self, x: Array) -> _Slopes:
        """Computes the slopes along states x (trials, 1 + K, n)."""
        along = self.model.slopes_along(x)
        H = np.matmul(self.whitening, np.where(self.seen[..., None], along.H, 0.0))
        return _Slopes(along.F, H)

    def _moved(self, F: Array, D: Array) -> Array:
        """Computes what changes D (..., N, p) of u change of the start and of the states at each
        epoch (1 + K, ..., n, p), by the slopes F (..., K, n, n) of the transitions."""
        X = np.matmul(self.gains[0], D[..., self.unknowns[0], :])
        out = np.empty((1 + self.model.epochs, *X.shape))
        out[0] = X
        for k in range(self.model.epochs):
            # dx_k = F_k dx_k-1 + G_k du_k
            noise = np.matmul(self.gains[k + 1], D[..., self.unknowns[k + 1], :])
            np.add(np.matmul(F[..., k, :, :], out[k]), noise, out=out[k + 1])
        return out

    def _changed(self, slopes: _Slopes, moved: Array) -> Array:
        """Computes (B - A) D (trials, M, p), of which the frozen slopes move the states by X D
        (1 + K, ..., n, p).

        Where the slopes are the frozen ones it is 0, and no difference of large numbers.
        """
        F = slopes.F - self.slopes.F
        H = slopes.H - self.slopes.H
        change = np.zeros((len(F), *moved.shape[-2:]))
        out = []
        for k in range(self.model.epochs):
            # With dx = X D and dx + e by the slopes of B: e_k = F_k e_k-1 + (F_k - F0_k) dx_k-1.
            change = np.matmul(slopes.F[:, k], change) + np.matmul(F[:, k], moved[k])
            out.append(np.matmul(slopes.H[:, k], change) + np.matmul(H[:, k], moved[k + 1]))
        return np.concatenate(out, axis=1)

    def F(self, u: Array, r: Array) -> Array:
        """Computes eq. (11), H+ (h - z) (trials, N), for h - z = (u; r)."""
        return multiply(self.inverse, np.concatenate([u, r], axis=1))

    def divided(self, F: Array, x: Array) -> tuple[Array, Array]:
        """Computes J_F^-1 F (trials, N) at states x (trials, 1 + K, n), J_F = I + (I + A' A)^-1 A'
        (B - A), by M equations in place of N (Woodbury), and whether there is none:

        J_F^-1 = I - gain (I + C gain)^-1 C,   C = B - A.
        """
        out = np.empty_like(F)
        singular = np.zeros(len(F), dtype=bool)
        for rows in self._pieces(len(F)):
            slopes = self.slopes_along(x[rows])
            columns = F[rows][..., None]
            C_F = self._changed(slopes, self._moved(self.slopes.F, columns))
            w, none = solve(self._core(slopes), C_F)
            out[rows] = F[rows] - multiply(self.gain, w[..., 0])
            singular[rows] = none & finite(F[rows])
        return out, singular

    def _core(self, slopes: _Slopes) -> Array:
        """Computes I + C gain (trials, M, M)."""
        C_gain = self._changed(slopes, self._moved_gain)
        return np.eye(C_gain.shape[1]) + C_gain

    def _pieces(self, trials: int) -> Iterator[slice]:
        """Yields the trials whose matrices are held at once."""
        M = self.seen.size
        at_once = max(1, int(_AT_ONCE / (M * max(M, len(self.gain)))))
        for i in range(0, trials, at_once):
            yield slice(i, i + at_once)

    @cached_property
    def _moved_gain(self) -> Array:
        return self._moved(self.slopes.F, self.gain)

    @cached_property
    def _moved_root(self) -> Array:
        N = self.Q.shape[1]
        return self._moved(self.slopes.F, self.Q[:N])

    def covariances(self, at: _Iterates) -> Array:
        """Computes the covariances (trials, 1 + K, n, n) of the states of iterates; NaN of those
        that are not finite."""
        n = self.model.n
        P = np.full((*at.x.shape, n), np.nan)
        usable = np.flatnonzero(finite(at.x) & finite(at.u))
        for piece in self._pieces(len(usable)):
            rows = usable[piece]
            P[rows] = self.sandwich(self.slopes_along(at.x[rows]))
        at.calls[usable] += (1 + n) * self.model.evaluations
        return P

    def sandwich(self, slopes: _Slopes) -> Array:
        """Computes the covariances (trials, 1 + K, n, n) of the states at the root: X J_F^-1 H+ H+'
        J_F^-' X' with X = dx/du, which moves from epoch to epoch as states do.

        H+ H+' = (I + A' A)^-1 = Q1 Q1'.
        """
        N = self.Q.shape[1]
        W, _ = solve(self._core(slopes), self._changed(slopes, self._moved_root))
        T = self._moved(slopes.F, self.Q[:N] - np.matmul(self.gain, W))
        P = np.matmul(T, transposed(T))
        return np.moveaxis(P, 0, 1)
