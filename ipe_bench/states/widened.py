"""Covariances of paths of largest density that hold where the density is not normal."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.batches import take
from ipe_bench.basics.linalg import Array
from ipe_bench.states.algebra import principal, transposed
from ipe_bench.states.whole_paths import PathDensity, Settled, Tangents

_FAR = 3.0
"""Standard deviations from the path at which the cost is looked at."""
_NORMAL = 0.05
"""Part of its rise by which a cost there may differ from that of a normal density before it is
followed."""
_MOST = 100.0
"""Times its variance that a direction gets at most."""
_NUMBERS = 5e5
"""Numbers of the slopes that are held at once: they stay in a processor's cache."""
_LANES = 8
"""Trials at least that are held at once: machine code takes no more time for them than for one."""


def widened(density: PathDensity, at: Settled, tangents: Tangents) -> tuple[Array, Array]:
    """Computes the covariances (trials, 1 + K, n, n) of the affine model about paths, widened by
    what the cost says, and the evaluations (trials,) that this took.

    Along each axis of the last states' covariance the path is moved by c = 3 deviations to both
    sides, and a step of the affine model lets the rest of it follow. By this the cost rises by dJ,
    which is c^2 where the density is normal: the variance along the axis is multiplied by the
    larger of both c^2 / dJ, but not made smaller. The step itself is b c^2 where the valley of the
    cost bends: it adds the second moment of that, 3 b b'.
    """
    P = np.empty((*at.x.shape, at.x.shape[-1]))
    calls = np.empty(len(P))
    sides = 2 * density.model.n
    at_once = max(_LANES, _slopes_at_once(density) // sides)
    for i in np.split(np.arange(len(P)), range(at_once, len(P), at_once)):
        P[i], calls[i] = _of_some(density.subset(i), take(at, i), take(tangents, i))
    return P, calls


def _slopes_at_once(density: PathDensity) -> int:
    """Paths whose slopes are held at once."""
    return max(1, int(_NUMBERS / (density.model.n**2 * density.model.epochs)))


def _of_some(density: PathDensity, at: Settled, tangents: Tangents) -> tuple[Array, Array]:
    trials, epochs, n = at.x.shape
    P, crossed = density.spread(tangents)
    lines, inverse = _lines(P[:, -1], crossed)
    sides = np.stack([lines, -lines], axis=1).reshape(-1, epochs, n)
    owner = np.repeat(np.arange(trials), 2 * n)
    beside = at.x[owner] + _FAR * sides
    moved = density.subset(owner).settled(beside)
    cost = moved.cost
    calls = moved.calls
    bends = np.zeros(sides.shape)
    known = (sides == 0).all(axis=(1, 2))
    # dJ / c^2 is 1 where the density is normal.
    rise = cost / _FAR**2 - at.cost[owner] / _FAR**2
    normal = np.abs(rise - 1.0) <= _NORMAL
    bent = np.flatnonzero(~known & ~normal)
    at_once = _slopes_at_once(density)
    for rows in np.split(bent, range(at_once, len(bent), at_once)):
        own = owner[rows]
        some = density.subset(own)
        there = take(moved, rows)
        # The rest of the path follows by a step of the affine model.
        step = some.step(take(tangents, own), there)
        axis = rows % n
        # What the step would move along the axis itself is taken back.
        back = np.sum(inverse[own, axis] * step[:, -1], axis=1)
        line = lines[own, axis]
        step = step - line * back[:, None, None]
        followed = some.settled(there.x + step)
        lower = followed.cost <= there.cost
        bends[rows[lower]] = step[lower]
        cost[rows[lower]] = followed.cost[lower]
        calls[rows] += followed.calls
    dJ = (cost - at.cost[owner]).reshape(trials, 2, n)
    extra = _rarer(dJ)
    extra[known.reshape(trials, 2, n)[:, 0]] = 0.0
    stretched = np.sqrt(extra)[..., None, None] * lines
    # b is the mean of both sides' steps over c^2, and E t^4 = 3 of a standard normal t.
    both = bends.reshape(trials, 2, n, epochs, n).sum(axis=1)
    bends = np.sqrt(3.0) * (both / (2 * _FAR**2))
    # P + W' W, with a row of W for each line and each bend.
    W = np.moveaxis(np.concatenate([stretched, bends], axis=1), 1, 2)
    P = P + np.matmul(transposed(W), W)
    return P, calls.reshape(trials, 2 * n).sum(axis=1)


def _lines(P: Array, crossed: Array) -> tuple[Array, Array]:
    """Computes how paths move (trials, n, 1 + K, n) where the last states do by a deviation along
    each axis of their covariance P, and the inverse of these axes (trials, n, n)."""
    _, inverse = principal(P)
    # cov(x_k, x_K) G^-' with P = G G', a row for each axis.
    lines = np.moveaxis(np.matmul(crossed, transposed(inverse)[:, None]), -1, 1)
    # But for round-off the last states move by one deviation already.
    along = np.sum(inverse * lines[:, :, -1], axis=-1)
    return lines / np.where(along > 0, along, 1.0)[..., None, None], inverse


def _rarer(rise: Array) -> Array:
    """Computes by how much more than once the variance an axis has (trials, n), of rises
    (trials, 2, n) to both sides."""
    least = _FAR**2 / _MOST
    ratio = _FAR**2 / np.fmax(rise, least).min(axis=1)
    return np.maximum(ratio, 1.0) - 1.0
