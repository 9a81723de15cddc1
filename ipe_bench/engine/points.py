"""Statistical linear regression by points in machine code: of a function y = g(x) about N(m, P), by
points s and weights w and c of the standard normal distribution.

    x = m + L s,   P = L L'
    mean = sum w y,   d = y - mean,   M = sum c d s',   A = M L^-1,   W = sum c d d' - M M'

The bits of a trial depend on its own numbers alone.
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


class PointSize(NamedTuple):
    """Holds the numbers on which machine code depends."""

    n: int
    """States."""
    m: int
    """Values of the function."""

    @property
    def spread(self) -> tuple[int, ...]:
        """Numbers of m, P, L and x of a trial."""
        return self.n, self.n**2, self.n**2, self.n

    @property
    def regression(self) -> tuple[int, ...]:
        """Numbers of L, M, A, W, the mean and y of a trial."""
        across = self.m * self.n
        return self.n**2, across, across, self.m**2, self.m, self.m


def spread_points(m: Array, P: Array, s: Array) -> tuple[Array, Array]:
    """Returns the points x (trials, p, n) and L (trials, n, n), not finite where P has a pivot
    below 0, of m (trials, n), P (trials, n, n) and s (p, n)."""
    trials, n = m.shape
    x = np.empty((trials, *s.shape))
    L = np.empty((trials, n, n))
    size = PointSize(n, 0)
    _run("spreads", size, size.spread, [own(m), own(P), s, L, x], len(s))
    return x, L


def regress(y: Array, L: Array, s: Array, w: Array, c: Array) -> tuple[Array, Array, Array, Array]:
    """Returns the mean (trials, m), M and A (trials, m, n) and W (trials, m, m) of values y
    (trials, p, m) at such points."""
    trials, points, m = y.shape
    size = PointSize(s.shape[1], m)
    M = np.empty((trials, m, size.n))
    results = np.empty((trials, m)), M, np.empty_like(M), np.empty((trials, m, m))
    _run("regressions", size, size.regression, [L, s, w, c, own(y), *results], points)
    return results


def _run(
    name: str, size: PointSize, parts: tuple[int, ...], arrays: list[Array], points: int
) -> None:
    _, frame = aligned(sum(parts) * compiled.width())
    _compiled(name, size, len(arrays))(*map(at, arrays), len(arrays[0]), points, frame)


@functools.cache
def _compiled(name: str, size: PointSize, pointers: int) -> Callable[..., None]:
    kinds: tuple[Any, ...] = (*[POINTER] * pointers, INTEGER, INTEGER, POINTER)
    return emitted(name, size, compiled.width(), kinds)
