"""Solves the equations of chains of epochs in machine code, each trial by itself.

A chain has states x and multipliers l of epochs k = 0 ... K, with x[-1] = 0 and l[K+1] = 0:

    x[k] - A[k] x[k-1] - Q[k] l[k] = a[k]
    (B' B + D) x[k] + l[k] - A[k+1]' l[k+1] = B' v,   Q = G G' and a diagonal D

They are those of a Kalman filter and smoother with readings v of B x and readings of 0 of x, of
variance 1 / D. Its covariances are kept as F F' with a triangular F (Bierman, Factorization Methods
for Discrete Sequential Estimation, 1977): from epoch to epoch by orthogonal rows of (A F, G) (Morf
and Kailath, IEEE Trans. Autom. Control 20, 1975), and by taking in one reading after another, with
a row b of B or of a root of D and s = F F' b (Carlson, AIAA J. 11, 1973). On the way there it is u
<- u + s w, w = (v - b' u) / (1 + b' s), and on the way back, by the multipliers (Bryson and
Frazier, 1963),

    x = u + F F' A' l[k+1],   l <- A' l[k+1],   l <- l + b (w - s' l / (1 + b' s)) from the last
    reading to the first.

Nothing is inverted, so that G may be of any rank, and a prior however wide costs no digits. What
the first x leaves of the right sides is solved for once more, after which steps hold but for
round-off. A trial has the same bits in any batch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, own
from ipe_bench.engine import compiled
from ipe_bench.engine.compiled import INTEGER, POINTER, aligned, at
from ipe_bench.engine.integrator import emitted

_KEPT = 4_000_000
"""Numbers at most of a frame that is kept for the next call."""
_FIRST = [(0, 0), (1, 0), (0, 0), (0, 0)]
"""Zeros in front of epochs: nothing moves into the first one, and nothing is read there."""
_ARGUMENTS = (*[POINTER] * 9, INTEGER, INTEGER, POINTER)


class Epoch(NamedTuple):
    """Holds what is kept of an epoch: how many numbers each part has, and where they lie."""

    A: Any
    B: Any
    """The m readings' rows, then a row of a root of D for each state."""
    a: Any
    v: Any
    F: Any
    u: Any
    """The state of this pass, on the way there and back."""
    x: Any
    """The sum of u over the passes."""
    multipliers: Any
    S: Any
    """s = F F' b of each row."""
    size: Any
    """1 + b' s of each row."""
    w: Any


class ChainSize(NamedTuple):
    """Holds the numbers on which machine code depends."""

    n: int
    """States of an epoch."""
    m: int
    """Rows of B that are readings."""
    q: int
    """Columns of G."""
    parts: Epoch
    """Numbers of what is kept of each epoch."""
    working: tuple[int, ...]
    """Numbers of (A F, G), of products, of A' l, of U, and of two more matrices: what is kept of
    one epoch at a time."""

    @classmethod
    def of(cls, n: int, m: int, q: int) -> ChainSize:
        square = n * n
        rows = m + n
        across = rows * n
        # In the order in which they are declared.
        parts = Epoch(square, across, n, rows, square, n, n, n, across, rows, rows)
        working = n * (n + max(m, q)), n + q, n, square, square, square
        return cls(n, m, q, parts, working)


def solve_chains(A: Array, B: Array, D: Array, G: Array, a: Array, v: Array) -> Array:
    """Returns x (trials, 1 + K, n) of A (trials, K, n, n), B (trials, K, m, n) and v (trials, K, m)
    of the epochs from the second on, and of D and a (trials, 1 + K, n) and G (1 + K, n, q)."""
    x = np.empty(D.shape)
    _run(A, B, D, G, a, v, x, None, None)
    return x


def filtered_chains(A: Array, B: Array, G: Array) -> Array:
    """Returns the covariances P (trials, 1 + K, n, n) of x by the readings up to each epoch,
    without damping."""
    return _covariances(A, B, G, smoothed=False)[0]


def smoothed_chains(A: Array, B: Array, G: Array) -> tuple[Array, Array]:
    """Returns the covariances P (trials, 1 + K, n, n) of x by all readings, and those of x with
    that of the last epoch.

    No covariance is inverted, nor one taken from another: what later readings tell of x, U U', is
    as if the columns of U were read,

        F F' <- ((F F')^-1 + U U')^-1,   U <- A' C,   C C' = ((B' B + U U')^-1 + Q)^-1.
    """
    return _covariances(A, B, G, smoothed=True)


def _covariances(A: Array, B: Array, G: Array, smoothed: bool) -> tuple[Array, Array]:
    trials, K, m, n = B.shape
    P = np.empty((trials, 1 + K, n, n))
    crossed = np.empty(P.shape)
    nothing = np.zeros(P.shape[:3])
    v = np.zeros((trials, K, m))
    _run(A, B, nothing, G, nothing, v, None, P, crossed if smoothed else None)
    return P, crossed


def _run(A: Array, B: Array, D: Array, G: Array, *more: Array | None) -> None:
    """Runs machine code; what is None is not asked for."""
    trials, epochs, n = D.shape
    size = ChainSize.of(n, B.shape[2], G.shape[2])
    free = _free_frames(size, epochs)
    try:
        memory, frame = free.pop()
    except IndexError:
        memory, frame = _new_frame(size, epochs)
    arrays = [None if one is None else own(one) for one in (A, B, D, G, *more)]
    pointers = [None if one is None else at(one) for one in arrays]
    _compiled(size)(*pointers, trials, epochs, frame)
    # What must be 0 stays 0, and all else is written before it is read.
    if memory.size <= _KEPT:
        free.append((memory, frame))


@functools.lru_cache(maxsize=4)
def _free_frames(size: ChainSize, epochs: int) -> list[tuple[Array, int]]:
    """Returns the frames of earlier calls that no thread uses now."""
    return []


def _new_frame(size: ChainSize, epochs: int) -> tuple[Array, int]:
    # Before the first epoch lies one of zeros.
    room = sum(size.working) + (epochs + 1) * sum(size.parts)
    memory, frame = aligned(room * compiled.width())
    memory[:] = 0.0
    return memory, frame


@functools.cache
def _compiled(size: ChainSize) -> Callable[..., None]:
    return emitted("chains", size, compiled.width(), _ARGUMENTS)


def from_before(A: Array, B: Array, D: Array, v: Array) -> tuple[Array, Array, Array]:
    """Returns A, B and v of all epochs, those of the first included."""
    n = D.shape[2]
    # D stands for readings of 0, by rows of its root.
    roots = np.sqrt(D)[..., None] * np.eye(n)
    rows = np.concatenate([np.pad(B, _FIRST), roots], axis=2)
    return np.pad(A, _FIRST), rows, np.pad(v, [(0, 0), (1, 0), (0, n)])


def lower(W: Array) -> Array:
    """The lower triangular F (trials, n, n) with F F' = W W', by reflections of Householder."""
    trials, n, columns = W.shape
    # Sizes of columns may differ by all digits; without the largest ones in front, reflections
    # would lose those of the smaller ones (Powell and Reid, IFIP Congress 68, 1969).
    size = np.einsum("tij,tij->tj", W, W)
    order = np.argsort(-size, axis=1, kind="stable")
    V = np.zeros((trials, max(n, columns), n))
    V[:, :columns] = np.take_along_axis(W, order[:, None], axis=2).mT
    F = np.asarray(np.linalg.qr(V, mode="r")).mT
    return np.where(np.diagonal(F, axis1=1, axis2=2)[:, None] < 0, -F, F)
