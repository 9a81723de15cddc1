"""Whole paths as unknowns: their density along all epochs at once, and Gauss-Newton steps of all of
a path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask, finite, multiply
from ipe_bench.engine.rows import products
from ipe_bench.states.affine_paths import Given, Noise, Tangents
from ipe_bench.states.algebra import (
    Half,
    factor,
    half,
    lower_solve,
    mahalanobis,
    triangular,
)
from ipe_bench.states.base import StateModel
from ipe_bench.states.passes import kept_of
from ipe_bench.states.steps import BEYOND
from ipe_bench.states.student import Tails

_REACHED = 1e-9
"""Part of a state by which a path may miss the range of its noise or of the prior: round-off of a
solve."""
_AS_GOOD = 1e-6
"""Part of a cost by which it may rise where whole turns are taken from a path: round-off of large
angles."""
_UNREAD = 1e-3
"""Part of a reading's deviation by which a path may miss that range at most."""


@dataclass(frozen=True)
class Settled:
    """Holds paths whose steps lie in the range of their noise."""

    x: Array
    """(trials, 1 + K, n), from before the first transition."""
    gap: Array
    """x[k] - f(x[k-1]) (trials, K, n)."""
    residual: Array
    """R^-1/2 (z - h) (trials, K, m), in scales of readings with tails; 0 of missing readings."""
    cost: Array
    """-2 log p(path | readings) (trials,) up to a constant; infinite where that is not finite."""
    misfit: Array
    """The same, where readings with tails count in parts of the mean cost of one: chi-square with a
    degree for each reading, as about, at the path of largest density."""
    calls: Array
    """Evaluations of f and of h (trials,) that this took."""


@dataclass(frozen=True)
class PathDensity:
    r"""Weighs the paths of a model by readings z,

    .. math:: J(x) = |x_0 - m_0|^2_{P_0^{-1}} + \sum_k |w_k|^2 + \sum_k |z_k - h(x_k)|^2_{R_k^{-1}}.

    A step dx from a path solves the affine problem about it exactly. With gaps d, residuals r and
    multipliers l,

    .. math::
        dx_0 - P_0 l_0 &= m_0 - x_0 \\
        dx_k - A_k dx_{k-1} - Q_k l_k &= -d_k \\
        (H_k^T R_k^{-1} H_k + D_k) dx_k + l_k - A_{k+1}^T l_{k+1} &= H_k^T R_k^{-1} r_k

    where D damps it. A reading with tails counts in a step by the weight that its residual has,
    and in the covariance by the curvature of its own density. Neither P0 nor Q is inverted, so that
    singular ones are no special case. Without a transition into the first epoch, the states of both
    are the same: A = I and Q = 0.
    """

    model: StateModel
    z: Array
    """(trials, K, m)"""
    gains: Array
    """G (K, n, q), of 0 where no transition leads into an epoch."""
    inverses: Array
    """G^+ (K, q, n)."""
    short: bool
    """Whether the noise of some step does not reach every state."""
    noise: Noise
    start: Half
    """Of P0 (n, n)."""
    whitener: Array
    """R^-1/2 (trials, K, m, m), of missing readings that of unit variance, in scales of those with
    tails."""
    tails: Tails | None = None
    """The noise of the readings, unless all are normal."""

    @classmethod
    def of(cls, model: StateModel, z: Array) -> PathDensity:
        parts = kept_of(model).parts
        gains = parts.gains
        # G G^+ projects onto the range of the noise.
        inverses = np.linalg.pinv(gains)
        unreached = np.eye(model.n) - np.matmul(gains, inverses)
        short = bool((np.abs(unreached) >= _REACHED).any())
        # R^-1/2 = L^-1 with R = L L'.
        there = np.isfinite(z)
        both = there[..., :, None] & there[..., None, :]
        one = np.eye(z.shape[2])
        L = factor(np.where(both, parts.covariances, one))
        whitener = lower_solve(L, np.broadcast_to(one, L.shape))
        tails = Tails.of(model.degrees_of_freedom)
        if tails is not None:
            whitener = whitener / np.sqrt(tails.scale)[:, None]
        noise = Noise(triangular(parts.P[None])[0], gains)
        start = half(parts.P)
        return cls(model, z, gains, inverses, short, noise, start, whitener, tails)

    def subset(self, rows: NDArray[np.intp]) -> PathDensity:
        """Returns the density of the trials `rows`."""
        return replace(self, z=self.z[rows], whitener=self.whitener[rows])

    def settled(self, x: Array) -> Settled:
        """Returns the paths x (trials, 1 + K, n), each step moved into the range of its noise:

        x[k] <- f(x[k-1]) + G w,  w = G^+ (x[k] - f(x[k-1]))

        The cost is infinite if the start lies outside the range of the prior, where a path has no
        density.
        """
        x = x.copy()
        if not self.model.moved_first:
            x[:, 0] = x[:, 1]
        x[:, 0] = self._begun(x[:, 0])
        f, h = self.model.values_along(x)
        near = self.model.nearest_state(f, x[:, 1:])
        gap = x[:, 1:] - near
        # Whole turns between epochs; models without periods look for none.
        turns = near - f if any(self.model.state_periods) else np.zeros((0, 1, 1))
        turned = np.flatnonzero((np.abs(turns) > 0).any(axis=(1, 2)))
        if turned.size:
            shift = np.cumsum(turns[turned], axis=1)
            at = (x[turned], gap[turned], h[turned])
            x[turned], gap[turned], h[turned] = self.subset(turned)._unwound(*at, shift)
        # A gap out of the range of its noise moves the epochs after it, too: one after another.
        rows = np.flatnonzero(self._misses(x, gap))
        if rows.size:
            x[rows], gap[rows] = self._led(x[rows])
            h[rows] = self.model.values_along(x[rows])[1]
        calls = np.full(len(x), float(self.model.evaluations))
        calls[turned] += self.model.evaluations
        calls[rows] += self._leading
        return self._weighed(x, gap, h, calls)

    def _misses(self, x: Array, gap: Array) -> Mask:
        """Tells which paths (trials,) have a gap out of the range of its noise."""
        if not self.short:
            return np.zeros(len(x), dtype=bool)
        missed = np.abs(gap - products(self.gains, products(self.inverses, gap))).max(axis=1)
        largest = np.abs(x).max(axis=1)
        # Beside readings that are more precise than that, even round-off of a solve is a miss.
        finest = np.abs(self.whitener).max(axis=(1, 2, 3))[:, None]
        return ~(missed <= np.minimum(_REACHED * largest, _UNREAD / finest)).all(axis=1)

    def _unwound(self, x: Array, gap: Array, h: Array, shift: Array) -> tuple[Array, Array, Array]:
        """Returns the paths x, each in the turn of its start where that costs no more, with gaps
        and readings; a jump by a whole period between two epochs costs nothing.

        Where f or h of a state are other ones a period away, a path stays as it is.
        """
        moved = x.copy()
        moved[:, 1:] -= shift
        f, read = self.model.values_along(moved)
        left = moved[:, 1:] - f
        none = np.zeros(len(x))
        before = self._weighed(x, gap, h, none).cost
        after = self._weighed(moved, left, read, none).cost
        better = after <= before * (1 + _AS_GOOD)
        at = better[:, None, None]
        return np.where(at, moved, x), np.where(at, left, gap), np.where(at, read, h)

    def settled_exactly(self, at: Settled) -> Settled:
        """Returns the same paths without the round-off by which steps still miss the range of their
        noise; the calls are those beyond what was paid for."""
        if not self.short:
            return replace(at, calls=np.zeros(len(at.x)))
        x, gap = self._led(at.x)
        _, h = self.model.values_along(x)
        return self._weighed(x, gap, h, np.full(len(x), self._leading))

    @property
    def _leading(self) -> float:
        """Evaluations of f, and of f and h, where a path is led from epoch to epoch."""
        return 2.0 * self.model.evaluations - self.model.epochs

    def _weighed(self, x: Array, gap: Array, h: Array, calls: Array) -> Settled:
        there = np.isfinite(self.z)
        h = self.model.nearest(h, np.where(there, self.z, h))
        r = np.where(there, self.z - h, 0.0)
        # J = |x0 - m0|^2 + sum |w|^2 + sum |v|^2, with w = G^+ gap and v = R^-1/2 r.
        m, P = self.model.prior
        begun = mahalanobis(x[:, 0] - m, P, self.start)
        w = products(self.inverses, gap)
        v = products(self.whitener, r)
        by_states = begun + _squared(w)
        costs = (v**2, v**2)
        if self.tails is not None:
            costs = (self.tails.costs(v), self.tails.alike(v))
        cost, misfit = (np.nan_to_num(by_states + _total(one), nan=np.inf) for one in costs)
        return Settled(x, gap, v, cost, misfit, calls)

    def _begun(self, start: Array) -> Array:
        """Returns the starts (trials, n), without the round-off by which they miss the range of the
        prior."""
        m = self.model.prior.mean
        prior = self.start
        if not prior.singular:
            return start
        # m0 + G G^- (x0 - m0), with P0 = G G'.
        u = prior.whitened((start - m)[:, None])[:, 0]
        within = m + multiply(prior.G, u)
        missed = np.abs(start - within) > _REACHED * np.abs(start)
        return np.where(missed, start, within)

    def _led(self, x: Array) -> tuple[Array, Array]:
        """Returns the paths x, moved into the range of the noise from epoch to epoch, and their
        gaps."""
        model = self.model
        x = x.copy()
        gap = np.zeros_like(x[:, 1:])
        for k in range(model.epochs):
            f = model.transition_into(k)(x[:, k]) if model.moves(k) else x[:, k]
            f = model.nearest_state(f, x[:, k + 1])
            w = multiply(self.inverses[k], x[:, k + 1] - f)
            gap[:, k] = multiply(self.gains[k], w)
            x[:, k + 1] = f + gap[:, k]
        return x, gap

    def about(self, x: Array) -> tuple[Settled, Tangents]:
        """Computes the paths x (trials, 1 + K, n) as they are, and the affine model about them."""
        f, h, A, H = self.model.slopes_along(x)
        gap = x[:, 1:] - self.model.nearest_state(f, x[:, 1:])
        calls = np.full(len(x), float(self.model.evaluations * (1 + self.model.n)))
        at = self._weighed(x, gap, h, calls)
        return at, self._tangents(A, H)

    def tangents(self, at: Settled) -> Tangents:
        """Computes the affine model about settled paths."""
        _, _, A, H = self.model.slopes_along(at.x)
        return self._tangents(A, H)

    def _tangents(self, A: Array, H: Array) -> Tangents:
        there = np.isfinite(self.z)
        B = products(self.whitener, np.where(there[..., None], H, 0.0))
        return Tangents(A, B)

    def step(self, tangents: Tangents, at: Settled, damping: Array | None = None) -> Array:
        """Computes the steps dx (trials, 1 + K, n) from settled paths, not finite of a trial that
        has none; with D = diag(damping (trials, 1 + K, n))."""
        # The right sides: m0 - x0, then -d_k, and H' R^-1 r = B' v.
        a = np.concatenate([self.model.prior.mean - at.x[:, :1], -at.gap], axis=1)
        residual = at.residual
        if self.tails is not None:
            # The slope of the costs is that of a weighted sum of squares.
            size = np.sqrt(self.tails.weights(residual))
            residual = size * residual
            tangents = replace(tangents, B=size[..., None] * tangents.B)
        return self.noise.states(tangents, a, residual, damping)

    def spread(self, tangents: Tangents, at: Settled) -> Given:
        """Computes what all readings say of the states of the affine model about settled paths."""
        if self.tails is not None:
            size = np.sqrt(self.tails.curvatures(at.residual))
            tangents = replace(tangents, B=size[..., None] * tangents.B)
        return self.noise.spread(tangents)

    def weights(self, at: Settled) -> Array | None:
        """Returns by how much readings (trials, K, m) count, as `Tracks` has it."""
        if self.tails is None:
            return None
        share = self.tails.weights(at.residual) / self.tails.weights(0.0 * at.residual)
        return np.where(np.isfinite(self.z), share, np.nan)

    def beyond_digits(self, tangents: Tangents, x: Array) -> Mask:
        """Tells about which paths x (trials, 1 + K, n) readings are so precise that no digits are
        left of what they say (trials,), or that are not finite."""
        return (self.noise.doubt(tangents, x) > BEYOND) | ~finite(x)

    def size(self, tangents: Tangents, step: Array) -> Array:
        """Computes dx' (Hessian of Gauss and Newton) dx (trials,): a step's squared length in
        deviations of the path."""
        # The terms of J that the step adds, in the affine model.
        after = step[:, 1:]
        w = products(self.inverses, after - products(tangents.A, step[:, :-1]))
        v = products(tangents.B, after)
        u = self.start.whitened(step[:, :1])
        return _squared(w) + _squared(v) + _squared(u)

    def blind_variances(self, tangents: Tangents) -> Array:
        """Computes the variances (trials, 1 + K, n) of states that nothing is read of, along
        paths."""
        return self.noise.blind_variances(tangents)


def _squared(a: Array) -> Array:
    """Computes |a|^2 (trials,) of vectors at all epochs (trials, K, n)."""
    return _total(a**2)


def _total(a: Array) -> Array:
    return np.sum(a, axis=(1, 2))
