"""What readings that are precise beside what was known before leave of the digits of floats, and
the steps of whole paths that hold beside such readings."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, multiply
from ipe_bench.engine.chains import from_before, lower
from ipe_bench.states.algebra import upper_solve

BEYOND = 1e25
"""Variance of what is read, in parts of that of its reading, above which round-off counts beside
what readings leave."""


def precise(H: Array, P: Array, R: Array, most: float) -> Mask:
    """Tells in which trials readings (trials, K, m) of slopes H (trials, K, m, n) and variances R
    are so precise beside the variances P (trials, K, n) before them that what is read has more than
    `most` times the variance of its reading."""
    # Not the variance of what is read, which may be small by cancellation of large terms.
    deviation = np.sqrt(np.maximum(P, 0.0))
    largest = np.einsum("tkmi,tki->tkm", np.abs(H), deviation)
    return np.asarray((largest**2 > most * R).any(axis=(1, 2)))


def beyond_digits(H: Array, x: Array, P: Array, R: Array) -> Mask:
    """Tells in which trials (trials,) states x (trials, K, n), or their variances P before readings
    of slopes H and variances R, are so large beside R that no digits are left of what is read."""
    # Of a state itself half a unit in the last place is lost, of a covariance one in each step.
    size = np.fmax(P, (x / 10) ** 2)
    return precise(H, size, R, BEYOND)


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
