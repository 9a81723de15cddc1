"""Paths that tangents cannot improve, as where a square that is read turns back."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, finite, multiply
from ipe_bench.states.algebra import root
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.whole_paths import PathDensity, Settled

_BLIND = 1e-9
"""Part of the prior's variance along a direction that readings that tell nothing of it may take."""
_AFFINE = 1e-6
"""Part of a cost by which it differs at most from that of an affine model."""


def at_saddles(density: PathDensity, at: Settled, start: Normal) -> tuple[Mask, Array]:
    """Tells which paths (trials,) may lie at a saddle, given what tangents say of the start, and
    the calls (trials,) that this took.

    Where a function turns back, its tangents say nothing of some direction of the start, and steps
    by tangents never leave. So the start moves by a deviation along such directions, and the path
    with it. The readings of an affine model stay the same, and the cost grows by that of the start.
    """
    found = np.zeros(len(at.x), dtype=bool)
    calls = np.zeros(len(at.x))
    G = root(density.model.prior.covariance)
    untold = _untold(G, start.covariance)
    rows = np.flatnonzero(untold.any(axis=1))
    if not rows.size:
        return found, calls
    some = density.subset(rows)
    x = at.x[rows]
    u = multiply(np.linalg.pinv(G), x[:, 0] - density.model.prior.mean)
    step = untold[rows]
    moved = some.settled(led_from(some.model, x[:, 0] + multiply(G, step), at.gap[rows]))
    affine = at.cost[rows] + ((u + step) ** 2 - u**2).sum(axis=1)
    found[rows] = ~(np.abs(moved.cost - affine) <= _AFFINE * (1 + affine))
    calls[rows] = moved.calls + density.model.evaluations
    return found, calls


def _untold(G: Array, covariance: Array) -> Array:
    """Returns a unit vector u (trials, r), where nothing is told of G u; 0 where something is told
    of each, with the prior's covariance G G' and those after the readings (trials, n, n)."""
    inverse = np.linalg.pinv(G)
    left = inverse @ covariance @ inverse.T
    known = finite(left)
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], left, 0.0))
    blind = values >= 1 - _BLIND
    # Weights that differ: their sum lies on no other symmetry, as that of x and y in x - y.
    weights = blind / np.arange(1.0, values.shape[1] + 1)
    u = multiply(vectors, weights)
    size = np.linalg.norm(u, axis=1, keepdims=True)
    return u / np.where(size > 0, size, 1.0)


def led_from(model: StateModel, start: Array, gap: Array) -> Array:
    """Returns the paths (trials, 1 + K, n) from starts (trials, n), with noise gap (trials, K,
    n)."""
    x = start
    path = [x]
    for k in range(model.epochs):
        if model.moves(k):
            x = model.transition_into(k)(x) + gap[:, k]
        path.append(x)
    return np.stack(path, axis=1)
