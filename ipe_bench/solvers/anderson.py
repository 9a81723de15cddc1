"""Accelerates the fixed-point iteration by Anderson's method (Walker and Ni, SIAM J. Numer. Anal.
49, 2011)."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array, multiply

_DEPENDENT = 1e-12
"""Differences of F that are the same to this share are taken for one."""


def accelerated(x: Array, F: Array, dx: Array, dF: Array) -> Array:
    """Computes the next x (trials, n), from the last differences of x and of F, each (trials, n,
    depth)."""
    gamma = _least_squares(dF, F)
    return x - F - multiply(dx - dF, gamma)


def push(memory: Array, newest: Array) -> Array:
    """Pushes the newest difference (trials, n) in front of the memory (trials, n, depth), and drops
    the oldest."""
    return np.concatenate([newest[:, :, None], memory[:, :, :-1]], axis=2)


def _least_squares(A: Array, b: Array) -> Array:
    """Computes the shortest gamma that minimises |b - A gamma|, with columns of A (trials, n,
    depth) scaled to 1."""
    length = np.linalg.norm(A, axis=1)
    usable = (length > 0) & np.isfinite(length)
    # A column of infinite length has no part in gamma.
    length = np.where(usable, length, np.inf)
    scaled = np.nan_to_num(A / length[:, None, :], nan=0.0, posinf=0.0, neginf=0.0)
    gamma = multiply(np.linalg.pinv(scaled, rcond=_DEPENDENT), b)
    return gamma / length
