"""Covariances that are kept as F F' with a triangular F, where readings are so precise beside what
was known before that the covariance itself would lose the digits that they leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask, multiply
from ipe_bench.engine.chains import from_before, lower, smoothed_chains
from ipe_bench.states.algebra import half, lower_solve, transposed, upper_solve
from ipe_bench.states.base import Normal
from ipe_bench.states.linearisation import Affine

_PRECISE = 1e8
"""Variance of what is read, in parts of that of its reading, above which a covariance loses half of
its digits."""
_BEYOND = 1e25
"""The same, above which round-off counts beside what readings leave, however it is kept."""


class Rooted(NamedTuple):
    """Holds normal distributions, one per trial, by roots of their covariances."""

    mean: Array
    """(trials, n)"""
    covariance: Array
    """F F' (trials, n, n)."""
    root: Array
    """F (trials, n, n), lower triangular."""

    @classmethod
    def of(cls, mean: Array, root: Array) -> Rooted:
        return cls(mean, np.matmul(root, transposed(root)), root)

    @classmethod
    def of_normal(cls, x: Normal) -> Rooted:
        return cls.of(x.mean, lower(half(x.covariance).G))

    def moved(self, move: Affine, G: Array) -> Rooted:
        """Returns the states A x + b + G w with w ~ N(0, I) by orthogonal rows of (A F, G) (Morf
        and Kailath, IEEE Trans. Autom. Control 20, 1975)."""
        m = multiply(move.A, self.mean) + move.b
        moved = np.matmul(move.A, self.root)
        return Rooted.of(m, lower(np.concatenate([moved, G], axis=2)))

    def told(self, H: Array, y: Array, N: Array) -> tuple[Rooted, Array]:
        """Returns the states after innovations y of readings H x + N v with v ~ N(0, I), and a root
        L of S = H P H' + N N', by orthogonal rows of

            N  H F         L        0
            0    F    ->   P H' L^-T  F+.
        """
        trials, m, n = H.shape
        before = np.zeros((trials, m + n, N.shape[2] + n))
        before[:, :m, :-n] = N
        before[:, :m, -n:] = np.matmul(H, self.root)
        before[:, m:, -n:] = self.root
        after = lower(before)
        L = after[:, :m, :m]
        e = lower_solve(L, y[..., None])[..., 0]
        mean = self.mean + multiply(after[:, m:, :m], e)
        return Rooted.of(mean, after[:, m:, m:]), L


class Step(NamedTuple):
    """Holds an epoch of an affine model, x = A x[k-1] + a + G w and v = B x + e with w, e ~
    N(0, I)."""

    A: Array
    """(trials, n, n)"""
    a: Array
    """(trials, n)"""
    G: Array
    """(trials, n, q)"""
    B: Array
    """(trials, m, n)"""
    v: Array
    """(trials, m)"""


@dataclass(frozen=True)
class Chain:
    """Holds the affine models of those trials whose covariances are kept by roots."""

    start: Rooted
    steps: Sequence[Step]

    def smoothed(self) -> Normal:
        """Returns the states (t, 1 + K, n) given all readings."""
        t, n = self.start.mean.shape
        most = max(n, *(step.G.shape[2] for step in self.steps))
        G = np.zeros((1 + len(self.steps), t, n, most))
        G[0, :, :, :n] = self.start.root
        for k, step in enumerate(self.steps):
            G[1 + k, :, :, : step.G.shape[2]] = step.G
        A = np.stack([step.A for step in self.steps], axis=1)
        B = np.stack([step.B for step in self.steps], axis=1)
        a = np.stack([self.start.mean, *(step.a for step in self.steps)], axis=1)
        v = np.stack([step.v for step in self.steps], axis=1)
        x = solved_by_roots(A, B, np.zeros_like(a), G, a, v)
        each = [smoothed_chains(A[[i]], B[[i]], G[:, i])[0] for i in range(t)]
        return Normal(x, np.concatenate(each))


class Smooth(NamedTuple):
    """Holds what smoothing by roots found."""

    rows: NDArray[np.intp]
    """Its trials (t,)."""
    states: Normal
    """From before the first transition (t, 1 + K, n), given all readings."""


def precise(H: Array, P: Array, R: Array, most: float = _PRECISE) -> Mask:
    """Tells in which trials readings (trials, K, m) of slopes H (trials, K, m, n) and variances R
    are so precise beside the variances P (trials, K, n) before them that covariances have to be
    kept by roots."""
    # Not the variance of what is read, which may be small by cancellation of large terms.
    deviation = np.sqrt(np.maximum(P, 0.0))
    largest = np.einsum("tkmi,tki->tkm", np.abs(H), deviation)
    return np.asarray((largest**2 > most * R).any(axis=(1, 2)))


def beyond_digits(H: Array, x: Array, P: Array, R: Array) -> Mask:
    """Tells in which trials (trials,) states x (trials, K, n), or their variances P before readings
    of slopes H and variances R, are so large beside R that no digits are left of what is read."""
    # Of a state itself half a unit in the last place is lost, of a covariance one in each step.
    size = np.fmax(P, (x / 10) ** 2)
    return precise(H, size, R, _BEYOND)


def solved_by_roots(A: Array, B: Array, D: Array, G: Array, a: Array, v: Array) -> Array:
    """Returns the same x as `solve_chains` where F F' of a state is so large that a multiplier's
    round-off moves it; G may have trials, (1 + K, trials, n, q).

    What the readings of an epoch and later ones say of its state, |C x - c|^2, is kept by
    orthogonal rows (Dyer and McReynolds, J. Optim. Theory Appl. 3, 1969). With x = A x[k-1] + a +
    G w and the readings of 0 of w,

        C G  C A  c - C a          R  S  r
                             ->
         I    0      0             0  Y  y,

    so that w = R^-1 (r - S x[k-1]), and |Y x[k-1] - y|^2 is said of the state before.
    """
    A, B, v = from_before(A, B, D, v)
    trials, epochs, n = a.shape
    q = G.shape[-1]
    Y = np.zeros((trials, n, n))
    y = np.zeros((trials, n))
    known = []
    for k in reversed(range(epochs)):
        C = np.concatenate([B[:, k], Y], axis=1)
        c = np.concatenate([v[:, k], y], axis=1)
        rows = C.shape[1]
        both = np.zeros((trials, q + n + 1, rows + q))
        both[:, :q, :rows] = np.matmul(C, G[k]).mT
        both[:, q:-1, :rows] = np.matmul(C, A[:, k]).mT
        both[:, -1, :rows] = c - multiply(C, a[:, k])
        both[:, :q, rows:] = np.eye(q)
        both = lower(both)
        R = both[:, :q, :q]
        S = both[:, q:-1, :q]
        r = both[:, -1, :q]
        Y = both[:, q:-1, q:-1].mT
        y = both[:, -1, q:-1]
        known.append((R, S, r))
    x = np.empty(a.shape)
    before = np.zeros((trials, n))
    for k, (R, S, r) in enumerate(reversed(known)):
        left = r - multiply(S.mT, before)
        w = upper_solve(R, left[..., None])[..., 0]
        before = multiply(A[:, k], before) + a[:, k] + multiply(G[k], w)
        x[:, k] = before
    return x
