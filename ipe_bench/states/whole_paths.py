"""Whole paths as unknowns: their density along all epochs at once, and Gauss-Newton steps by one banded solve each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, finite, multiply
from ipe_bench.states.algebra import factor, half, lower_solve, mahalanobis, transposed
from ipe_bench.states.base import StateModel

_REACHED = 1e-9
"""Part of a state by which a path may miss the range of its noise or of the prior: round-off of a solve."""
_NUMBERS = 3e5
"""Numbers of the banded matrices that are held at once: they stay in a processor's cache."""


@dataclass(frozen=True)
class Settled:
    """Holds paths whose steps lie in the range of their noise."""

    x: Array
    """(trials, 1 + K, n), from before the first transition."""
    gap: Array
    """x[k] - f(x[k-1]) (trials, K, n)."""
    residual: Array
    """z - h (trials, K, m); 0 of missing readings."""
    cost: Array
    """-2 log p(path | readings) (trials,) up to a constant; infinite where that is not finite."""
    calls: Array
    """Evaluations of f and of h (trials,) that this took."""


@dataclass(frozen=True)
class Tangents:
    """Holds the affine model about paths."""

    A: Array
    """df/dx (trials, K, n, n)."""
    H: Array
    """dh/dx (trials, K, m, n)."""
    B: Array
    """R^-1/2 dh/dx (trials, K, m, n); 0 of missing readings."""


@dataclass(frozen=True)
class PathDensity:
    r"""Weighs the paths of a model by readings z,

    .. math:: J(x) = |x_0 - m_0|^2_{P_0^{-1}} + \sum_k |w_k|^2 + \sum_k |z_k - h(x_k)|^2_{R_k^{-1}}.

    A step dx from a path solves the affine problem about it exactly. With gaps d, residuals r and multipliers l,

    .. math::
        dx_0 - P_0 l_0 &= m_0 - x_0 \\
        dx_k - A_k dx_{k-1} - Q_k l_k &= -d_k \\
        (H_k^T R_k^{-1} H_k + D_k) dx_k + l_k - A_{k+1}^T l_{k+1} &= H_k^T R_k^{-1} r_k

    where D damps it. Neither P0 nor Q is inverted, so that singular ones are no special case. Without a transition
    into the first epoch, the states of both are the same: A = I and Q = 0.
    """

    model: StateModel
    z: Array
    """(trials, K, m)"""
    gains: Array
    """G (K, n, q), with columns of 0 where a step has less noise than others."""
    inverses: Array
    """G^+ (K, q, n)."""
    unreached: Array
    """I - G G^+ (K, n, n), onto what the noise of a step does not reach; 0 if each step's noise reaches every state."""
    whitener: Array
    """R^-1/2 (trials, K, m, m), of missing readings that of unit variance."""

    @classmethod
    def of(cls, model: StateModel, z: Array) -> PathDensity:
        still = np.zeros((model.n, 0))
        own = [model.gain(k) if model.moves(k) else still for k in range(model.epochs)]
        gains = np.zeros((model.epochs, model.n, max(G.shape[1] for G in own)))
        for k, G in enumerate(own):
            gains[k, :, : G.shape[1]] = G
        there = np.isfinite(z)
        both = there[..., :, None] & there[..., None, :]
        one = np.eye(z.shape[2])
        R = np.stack([model.R(k) for k in range(model.epochs)])
        L = factor(np.where(both, R, one))
        inverses = np.linalg.pinv(gains)
        unreached = np.eye(model.n) - np.matmul(gains, inverses)
        if (np.abs(unreached) < _REACHED).all():
            unreached = np.zeros_like(unreached)
        whitener = lower_solve(L, np.broadcast_to(one, L.shape))
        return cls(model, z, gains, inverses, unreached, whitener)

    def subset(self, rows: NDArray[np.intp]) -> PathDensity:
        """The density of the trials `rows`."""
        return replace(self, z=self.z[rows], whitener=self.whitener[rows])

    def settled(self, x: Array) -> Settled:
        """The paths x (trials, 1 + K, n), each step moved into the range of its noise:

        x[k] <- f(x[k-1]) + G w,  w = G^+ (x[k] - f(x[k-1]))

        The cost is infinite if the start lies outside the range of the prior, where a path has no density.
        """
        x = x.copy()
        if not self.model.moved_first:
            x[:, 0] = x[:, 1]
        x[:, 0] = self._begun(x[:, 0])
        f, h = self.model.values_along(x)
        gap = x[:, 1:] - self.model.nearest_state(f, x[:, 1:])
        missed = np.abs(multiply(self.unreached, gap)).max(axis=1)
        rows = np.flatnonzero(~(missed <= _REACHED * np.abs(x).max(axis=1)).all(axis=1))
        if rows.size:
            x[rows], gap[rows] = self._led(x[rows])
            h[rows] = self.model.values_along(x[rows])[1]
        calls = np.full(len(x), float(self.model.evaluations))
        calls[rows] += self._leading
        return self._weighed(x, gap, h, calls)

    def settled_exactly(self, at: Settled) -> Settled:
        """The same paths without the round-off by which steps still miss the range of their noise; the calls are those
        beyond what was paid for."""
        if not self.unreached.any():
            return replace(at, calls=np.zeros(len(at.x)))
        x, gap = self._led(at.x)
        return self._weighed(x, gap, self.model.values_along(x)[1], np.full(len(x), self._leading))

    @property
    def _leading(self) -> float:
        """Evaluations of f, and of f and h, where a path is led from epoch to epoch."""
        return 2.0 * self.model.evaluations - self.model.epochs

    def _weighed(self, x: Array, gap: Array, h: Array, calls: Array) -> Settled:
        there = np.isfinite(self.z)
        r = np.where(there, self.z - self.model.nearest(h, np.where(there, self.z, h)), 0.0)
        w = multiply(self.inverses, gap)
        v = multiply(self.whitener, r)
        m, P = self.model.prior
        cost = mahalanobis(x[:, 0] - m, P) + np.sum(w**2, axis=(1, 2)) + np.sum(v**2, axis=(1, 2))
        return Settled(x, gap, r, np.nan_to_num(cost, nan=np.inf), calls)

    def _begun(self, start: Array) -> Array:
        """The starts (trials, n), without the round-off by which they miss the range of the prior."""
        m, P = self.model.prior
        prior = half(P)
        if not prior.singular:
            return start
        within = m + np.matmul(prior.whitened(start - m), transposed(prior.G))
        missed = np.abs(start - within) > _REACHED * np.abs(start)
        return np.where(missed, start, within)

    def _led(self, x: Array) -> tuple[Array, Array]:
        """The paths x, moved into the range of the noise from epoch to epoch, and their gaps."""
        model, x = self.model, x.copy()
        gap = np.zeros_like(x[:, 1:])
        for k in range(model.epochs):
            f = model.transition_into(k)(x[:, k]) if model.moves(k) else x[:, k]
            f = model.nearest_state(f, x[:, k + 1])
            gap[:, k] = multiply(self.gains[k], multiply(self.inverses[k], x[:, k + 1] - f))
            x[:, k + 1] = f + gap[:, k]
        return x, gap

    def about(self, x: Array) -> tuple[Settled, Tangents]:
        """The paths x (trials, 1 + K, n) as they are, and the affine model about them."""
        f, h, A, H = self.model.slopes_along(x)
        gap = x[:, 1:] - self.model.nearest_state(f, x[:, 1:])
        calls = np.full(len(x), float(self.model.evaluations * (1 + self.model.n)))
        seen = np.where(np.isfinite(self.z)[..., None], H, 0.0)
        return self._weighed(x, gap, h, calls), Tangents(A, H, np.matmul(self.whitener, seen))

    def tangents(self, at: Settled) -> Tangents:
        """The affine model about settled paths."""
        return self.about(at.x)[1]

    def left(self, tangents: Tangents, at: Settled) -> Array:
        """What the equations of a step leave at step 0 (trials, 1 + K, 2, n): of multipliers and of states."""
        left = np.zeros((*at.x.shape[:2], 2, self.model.n))
        left[:, 0, 0] = self.model.prior.mean - at.x[:, 0]
        left[:, 1:, 0] = -at.gap
        v = multiply(self.whitener, at.residual)
        left[:, 1:, 1] = multiply(transposed(tangents.B), v)
        return left

    def step(self, tangents: Tangents, at: Settled, damping: Array | None = None) -> Array:
        """The steps dx (trials, 1 + K, n) from settled paths, NaN of a trial that has none; with
        D = diag(damping (trials, 1 + K, n))."""
        return self.solved(tangents, self.left(tangents, at)[..., None], damping)[..., 0]

    def solved(self, tangents: Tangents, right: Array, damping: Array | None = None) -> Array:
        """dx (trials, 1 + K, n, r) of the equations of a step, for r right sides (trials, 1 + K, 2, n, r)."""
        trials, K, n = len(right), self.model.epochs, self.model.n
        noise = np.matmul(self.gains, transposed(self.gains))
        Q = np.concatenate([self.model.prior.covariance[None], noise])
        C = np.zeros((trials, K + 1, n, n))
        C[:, 1:] = np.matmul(transposed(tangents.B), tangents.B)
        if damping is not None:
            np.einsum("tkii->tki", C)[:] += damping
        at_once = max(1, int(_NUMBERS / ((K + 1) * 2 * n * 6 * n)))
        parts = [slice(i, i + at_once) for i in range(0, trials, at_once)]
        return np.concatenate([_solved(Q, tangents.A[one], C[one], right[one]) for one in parts])

    def size(self, tangents: Tangents, step: Array) -> Array:
        """dx' (Hessian of Gauss and Newton) dx (trials,): a step's squared length in deviations of the path."""
        w = multiply(self.inverses, step[:, 1:] - multiply(tangents.A, step[:, :-1]))
        v = multiply(tangents.B, step[:, 1:])
        e = half(self.model.prior.covariance).whitened(step[:, :1])
        return np.sum(w**2, axis=(1, 2)) + np.sum(v**2, axis=(1, 2)) + np.sum(e**2, axis=(1, 2))

    def blind_variances(self, tangents: Tangents) -> Array:
        """The variances (trials, 1 + K, n) of states that nothing is read of, along paths."""
        A, K = tangents.A, self.model.epochs
        P = np.repeat(self.model.prior.covariance[None], len(A), axis=0)
        noise = np.matmul(self.gains, transposed(self.gains))
        variances = [np.diagonal(P, axis1=1, axis2=2)]
        for k in range(K):
            P = np.matmul(np.matmul(A[:, k], P), transposed(A[:, k])) + noise[k]
            variances.append(np.diagonal(P, axis1=1, axis2=2))
        return np.stack(variances, axis=1)


def _solved(Q: Array, A: Array, C: Array, right: Array) -> Array:
    """dx (trials, 1 + K, n, r) of the equations of `PathDensity`, their unknowns (l, dx) from epoch to epoch, by Q
    (1 + K, n, n), A (trials, K, n, n), C = H' R^-1 H + D (trials, 1 + K, n, n) and right sides."""
    # Imported late: SciPy's LAPACK costs a tenth of a second.
    from scipy.linalg.lapack import dgbsv  # pyright: ignore[reportAttributeAccessIssue]

    trials, epochs, _, n, columns = right.shape
    beside = 2 * n - 1
    band = np.zeros((trials, 2 * n * epochs, 3 * beside + 1))
    one = np.eye(n)
    _blocks(band, 0, 0, epochs)[:] = -Q
    _blocks(band, 0, 1, epochs)[:] = one
    _blocks(band, 1, 0, epochs)[:] = one
    _blocks(band, 1, 1, epochs)[:] = C
    _blocks(band, 2, 1, epochs - 1)[:] = -A
    _blocks(band, 1, 2, epochs - 1)[:] = -transposed(A)
    found = np.full((trials, epochs, n, columns), np.nan)
    for i in np.flatnonzero(finite(A) & finite(C) & finite(right)):
        _, _, unknowns, failed = dgbsv(
            beside, beside, band[i].T, right[i].reshape(-1, columns), overwrite_ab=1
        )
        if not failed:
            found[i] = unknowns.reshape(epochs, 2, n, columns)[:, 1]
    return found


def _blocks(band: Array, row: int, column: int, count: int) -> Array:
    """A view (trials, count, n, n) of blocks of matrices in LAPACK's band storage, band[trial, column, place]: the
    block in this row and column of blocks, and those two blocks further down and right each."""
    trials, _, width = band.shape
    n = (width + 2) // 6
    # One further down is one place further on, one further right a column but for one place.
    down, right = band.itemsize, band.itemsize * (width - 1)
    first = 2 * (2 * n - 1) + n * row + n * column * (width - 1)
    start = band.reshape(trials, -1)[:, first:]
    strides = (band.strides[0], 2 * n * (down + right), down, right)
    return as_strided(start, (trials, count, n, n), strides)
