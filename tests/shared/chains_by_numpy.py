"""Chains of epochs in NumPy, as `engine.chains` describes them, epoch by epoch."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import multiply
from ipe_bench.engine.chains import Epoch, from_before, lower

_FIRST = [(0, 0), (1, 0), (0, 0), (0, 0)]
"""Zeros in front of epochs: nothing moves into the first one, and nothing is read there."""


def run(A, B, D, G, a, v, x, P, crossed):
    """Fills x, or P and with it crossed, as `engine.chains` says; what is None is not asked for."""
    if x is not None:
        x[:] = solve_chains(A, B, D, G, a, v)
    if P is not None:
        P[:], across = chain_covariances(A, B, G, crossed is not None)
        if crossed is not None:
            crossed[:] = across


def solve_chains(A, B, D, G, a, v):
    trials, epochs, n = D.shape
    chain = _begun(A, B, D, G, a, v)
    each = [Epoch(*[part[:, k] for part in chain]) for k in range(epochs)]
    # The second pass solves for what the first leaves of the right sides.
    for _ in range(2):
        chain.u[:] = 0.0
        for k, here in enumerate(each):
            # What lies before the first epoch counts for nothing: A is 0 there.
            _forward(here, each[k - 1].u)
        later = np.zeros((trials, n))
        for here in reversed(each):
            later = _backward(here, later)
        chain.x[:] += chain.u
        _refine(chain, G)
    return chain.x


def chain_covariances(A, B, G, smoothed):
    A = np.pad(A, _FIRST)
    B = np.pad(B, _FIRST)
    F = _filtered_roots(A, B, G)[0]
    crossed = np.empty_like(F)
    U = np.zeros_like(F[:, 0])
    ahead = np.broadcast_to(np.eye(F.shape[2]), U.shape)
    for k in reversed(range(F.shape[1] if smoothed else 0)):
        for column in np.moveaxis(U, 2, 0):
            _take_in(F[:, k], column)
        P = np.matmul(F[:, k], F[:, k].mT)
        crossed[:, k] = np.matmul(P, ahead)
        C = lower(np.concatenate([B[:, k].mT, U], axis=2))
        for g in G[k].T:
            s, size = _take_in(C, np.broadcast_to(g, C.shape[:2]))
            share = multiply(ahead.mT, g) / size[:, None]
            ahead = ahead - s[:, :, None] * share[:, None]
        U = np.matmul(A[:, k].mT, C)
        ahead = np.matmul(A[:, k].mT, ahead)
    return np.matmul(F, F.mT), crossed


def _begun(A, B, D, G, a, v):
    """All epochs of a chain before its first pass."""
    A, B, v = from_before(A, B, D, v)
    F, S, size = _filtered_roots(A, B, G)
    u, x, multipliers = map(np.zeros_like, (a, a, a))
    return Epoch(A, B, a.copy(), v, F, u, x, multipliers, S, size, np.zeros_like(v))


def _filtered_roots(A, B, G):
    """Returns F (trials, 1 + K, n, n), where F F' is the covariance of x by the rows B (trials, 1 +
    K, r, n) up to each epoch, and s and 1 + b' s of each row b; A (trials, 1 + K, n, n)."""
    trials, epochs, rows, _ = B.shape
    F = np.zeros(A.shape)
    S = np.zeros_like(B)
    size = np.ones((trials, epochs, rows))
    for k in range(epochs):
        # Prediction: F F' <- A F F' A' + G G' = W W' with W = (A F, G).
        moved = np.matmul(A[:, k], F[:, k - 1])
        noise = np.broadcast_to(G[k], (trials, *G[k].shape))
        W = np.concatenate([moved, noise], axis=2)
        F[:, k] = lower(W)
        for r in range(rows):
            # Update by one reading after another: s = F F' b and 1 + b' s.
            s, larger = _take_in(F[:, k], B[:, k, r])
            S[:, k, r] = s
            size[:, k, r] = larger
    return F, S, size


def _take_in(F, row):
    """F F' <- ((F F')^-1 + b b')^-1 for a row b, in place; returns F F' b (trials, n) and 1 + b' F
    F' b (trials,)."""
    t = multiply(F.mT, row)
    s = np.zeros_like(t)
    size = np.ones(len(t))
    for j in reversed(range(t.shape[1])):
        # From the last column to the first, size is 1 plus the squares of t so far (Carlson, 1973).
        column = F[:, :, j]
        along = t[:, j]
        larger = size + along**2
        root = np.sqrt(size * larger)
        kept = size / root
        share = along / root
        # F <- F size / root - s t / root in this column, then s <- s + F t by the old one.
        moved = column * along[:, None]
        column[:] = column * kept[:, None] - s * share[:, None]
        s = s + moved
        size = larger
    return s, size


def _forward(here, before):
    # Prediction: u <- A u + a.
    here.u[:] = multiply(here.A, before) + here.a
    for r in range(here.B.shape[1]):
        # Update: w = (v - b' u) / (1 + b' s), then u <- u + s w.
        known = np.sum(here.B[:, r] * here.u, axis=1)
        innovation = here.v[:, r] - known
        w = innovation / here.size[:, r]
        here.w[:, r] = w
        here.u[:] += here.S[:, r] * w[:, None]


def _backward(here, later):
    """Takes A' l of the epoch after, and returns that of this one."""
    # Smoothing: x = u + F F' A' l[k+1].
    here.u[:] += multiply(here.F, multiply(here.F.mT, later))
    for r in reversed(range(here.B.shape[1])):
        # Readings from the last to the first: w <- w - s' l / (1 + b' s), then l <- l + b w.
        known = np.sum(here.S[:, r] * later, axis=1)
        w = here.w[:, r] - known / here.size[:, r]
        here.w[:, r] = w
        later = later + here.B[:, r] * w[:, None]
    here.multipliers[:] = later
    return multiply(here.A.mT, later)


def _refine(chain, G):
    """Computes what u and the multipliers leave of a and of v."""
    # a <- a - u + A u[k-1] + G G' l.
    moved = multiply(chain.A, np.roll(chain.u, 1, axis=1))
    noise = multiply(np.matmul(G, G.mT), chain.multipliers)
    chain.a[:] = chain.a - chain.u + moved + noise
    # v <- v - B u - w.
    chain.v[:] = chain.v - multiply(chain.B, chain.u) - chain.w
