"""Solves the equations of chains of epochs, each trial by itself: in machine code, or by NumPy where none can be made.

A chain has states x and multipliers l of epochs k = 0 ... K, with x[-1] = 0 and l[K+1] = 0:

    x[k] - A[k] x[k-1] - Q[k] l[k] = a[k]
    (B' B + D) x[k] + l[k] - A[k+1]' l[k+1] = B' v,   Q = G G' and a diagonal D

They are those of a Kalman filter and smoother with readings v of B x and readings of 0 of x, of variance 1 / D. Its
covariances are kept as F F' with a triangular F: from epoch to epoch by orthogonal rows of (A F, G), and by taking in
one reading after another, with a row b of B or of a root of D and s = F F' b (Carlson, AIAA J. 11, 1973). On the way
there it is u <- u + s w, w = (v - b' u) / (1 + b' s), and on the way back

    x = u + F F' A' l[k+1],   l <- A' l[k+1],   l <- l + b (w - s' l / (1 + b' s)) from the last reading to the first.

Nothing is inverted, so that G may be of any rank, and a prior however wide costs no digits. What the first x leaves of
the right sides is solved for once more, after which steps hold but for round-off. A trial has the same bits in any
batch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, multiply, own
from ipe_bench.engine import compiled
from ipe_bench.engine.compiled import INTEGER, POINTER, aligned, at
from ipe_bench.engine.integrator import emitted

_ARGUMENTS = (*[POINTER] * 8, INTEGER, INTEGER, POINTER)


class ChainSize(NamedTuple):
    """Holds the numbers on which machine code depends."""

    n: int
    """States of an epoch."""
    m: int
    """Rows of B."""
    q: int
    """Columns of G."""
    parts: tuple[int, ...]
    """Numbers of A, rows, a, v, F, u, x and l, and of s, 1 + b' s and w of each row: what is kept of each epoch."""
    working: tuple[int, ...]
    """Numbers of (A F, G), of products and of A' l: what is kept of one epoch at a time."""

    @classmethod
    def of(cls, n: int, m: int, q: int) -> ChainSize:
        rows = m + n
        parts = n * n, rows * n, n, rows, n * n, n, n, n, rows * n, rows, rows
        return cls(n, m, q, parts, (n * (n + q), n + q, n))


def solve_chains(
    A: Array, B: Array, D: Array, G: Array, a: Array, v: Array, spread: bool = False
) -> tuple[Array, Array]:
    """Returns x (trials, 1 + K, n) and, if `spread`, P (trials, 1 + K, n, n), of A (trials, K, n, n), B (trials, K, m,
    n) and v (trials, K, m) of the epochs from the second on, and of D and a (trials, 1 + K, n) and G (1 + K, n, q)."""
    trials, epochs, n = D.shape
    given = [own(one) for one in (A, B, D, G, a, v)]
    if not compiled.available():
        return _by_numpy(*given)
    size = ChainSize.of(n, B.shape[2], G.shape[2])
    x, P = np.empty((trials, epochs, n)), np.empty((trials, epochs, n, n) if spread else 0)
    room = sum(size.working) + (epochs + 1) * sum(size.parts)
    memory, frame = aligned(room * compiled.width())
    memory[:] = 0.0
    _compiled(size)(*map(at, given), at(x), at(P), trials, epochs, frame)
    return x, P


@functools.cache
def _compiled(size: ChainSize) -> Callable[..., None]:
    return emitted("chains", size, compiled.width(), _ARGUMENTS)


def _by_numpy(A: Array, B: Array, D: Array, G: Array, a: Array, v: Array) -> tuple[Array, Array]:
    trials, epochs, n = D.shape
    # Nothing moves into the first epoch, and nothing is read there.
    A = np.concatenate([np.zeros((trials, 1, n, n)), A], axis=1)
    B = np.concatenate([np.zeros((trials, 1, *B.shape[2:])), B], axis=1)
    B = np.concatenate([B, np.sqrt(D)[..., None] * np.eye(n)], axis=2)
    v = np.pad(v, [(0, 0), (1, 0), (0, n)])
    F, S, size = filtered_roots(A, B, G)
    x = np.zeros((trials, epochs, n))
    # The second pass solves for what the first leaves of the right sides.
    for _ in range(2):
        u, multipliers, told = np.zeros_like(x), np.zeros_like(x), np.zeros_like(v)
        for k in range(epochs):
            # Forward: u <- A u + a, then u <- u + s w with w = (v - b' u) / (1 + b' s).
            u[:, k] = multiply(A[:, k], u[:, k - 1]) + a[:, k]
            for r in range(B.shape[2]):
                told[:, k, r] = (v[:, k, r] - np.sum(B[:, k, r] * u[:, k], axis=1)) / size[:, k, r]
                u[:, k] += S[:, k, r] * told[:, k, r, None]
        later = np.zeros((trials, n))
        for k in range(epochs - 1, -1, -1):
            # Back: x = u + F F' A' l[k+1].
            u[:, k] += multiply(F[:, k], multiply(_transposed(F[:, k]), later))
            # l <- l + b (w - s' l / (1 + b' s)), from the last reading to the first.
            for r in range(B.shape[2] - 1, -1, -1):
                told[:, k, r] -= np.sum(S[:, k, r] * later, axis=1) / size[:, k, r]
                later = later + B[:, k, r] * told[:, k, r, None]
            multipliers[:, k] = later
            later = multiply(_transposed(A[:, k]), later)
        x += u
        # What x and l leave of a and of v.
        noise = multiply(np.matmul(G, _transposed(G)), multipliers)
        a = a - u + multiply(A, np.roll(u, 1, axis=1)) + noise
        v = v - multiply(B, u) - told
    return x, np.matmul(F, _transposed(F))


def filtered_roots(A: Array, B: Array, G: Array) -> tuple[Array, Array, Array]:
    """Returns F (trials, 1 + K, n, n), where F F' is the covariance of x by the rows B (trials, 1 + K, r, n) up to each
    epoch, and s and 1 + b' s of each row b; A (trials, 1 + K, n, n)."""
    trials, epochs, rows, n = B.shape
    F = np.zeros((trials, epochs, n, n))
    S = np.zeros_like(B)
    size = np.ones((trials, epochs, rows))
    for k in range(epochs):
        noise = np.broadcast_to(G[k], (trials, *G[k].shape))
        # Prediction: F F' <- A F F' A' + G G', by orthogonal rows of (A F, G).
        F[:, k] = lower(np.concatenate([np.matmul(A[:, k], F[:, k - 1]), noise], axis=2))
        for r in range(rows):
            # Update by one reading after another: s = F F' b and 1 + b' s.
            S[:, k, r], size[:, k, r] = _take_in(F[:, k], B[:, k, r])
    return F, S, size


def lower(W: Array) -> Array:
    """The lower triangular F (trials, n, n) with F F' = W W'."""
    W, n = W.copy(), W.shape[1]
    F = np.zeros((*W.shape[:1], n, n))
    for i in range(n):
        square = np.sum(W[:, i] ** 2, axis=1)
        inverse = np.where(square > 0, 1 / np.where(square > 0, square, 1.0), 0.0)
        F[:, i, i] = np.sqrt(square)
        # The rows below lose their part along row i (modified Gram-Schmidt).
        share = multiply(W[:, i + 1 :], W[:, i]) * inverse[:, None]
        F[:, i + 1 :, i] = share * F[:, i, i, None]
        W[:, i + 1 :] -= share[:, :, None] * W[:, i, None, :]
    return F


def _take_in(F: Array, row: Array) -> tuple[Array, Array]:
    """F F' <- ((F F')^-1 + b b')^-1 for a row b, in place; returns F F' b (trials, n) and 1 + b' F F' b (trials,)."""
    v = multiply(_transposed(F), row)
    size, s = np.ones(len(v)), np.zeros_like(v)
    for j in range(v.shape[1] - 1, -1, -1):
        # From the last column to the first, size is 1 plus the squares of v so far (Carlson, 1973).
        larger = size + v[:, j] ** 2
        moved = F[:, :, j] * v[:, j, None]
        root = np.sqrt(size * larger)
        F[:, :, j] = F[:, :, j] * (size / root)[:, None] - s * (v[:, j] / root)[:, None]
        s = s + moved
        size = larger
    return s, size


def _transposed(A: Array) -> Array:
    return A.swapaxes(-1, -2)
