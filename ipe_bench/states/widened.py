"""Covariances of paths of largest density that hold where the density is not normal.

Tangents about such a path give the covariance of a normal density. Whether the density is normal is
seen from its cost a few deviations away, along each axis of the last states (`_looked_at`). Where
it is not, the path is moved step by step along the axis on which it differs most (`_followed`): at
each point the rest of the path is settled anew, and the weighted sum over points takes the place of
the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import take
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.states.algebra import principal, transposed
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.whole_paths import PathDensity, Settled, Tangents

_FAR = 3.0
"""Standard deviations from the path at which the cost is looked at."""
_NORMAL = 0.05
"""Part of its rise by which a cost there may differ from that of a normal density before the axis
is followed."""
_STRIDE = 1.5
"""Standard deviations between points of an axis: of a normal density the sum over such points
misses the integral by 3e-4."""
_OF_NORMAL = np.sqrt(2 * np.pi) / _STRIDE
"""Sum of a normal density over such points, in parts of that at the middle."""
_POINTS = 16
"""Points to either side of a path at most."""
_LITTLE = 0.1
"""Part of the second moment along an axis below which the tail behind a point is left out."""
_MOST = 10.0
"""Logarithm of the most that a point counts beside the path itself."""
_LEAST = 0.8
"""Part of the variance of any axis that a second moment has at least."""
_NUMBERS = 5e5
"""Numbers of the slopes that are held at once: they stay in a processor's cache."""
_LANES = 8
"""Trials at least that are held at once: machine code takes no more time for them than for one."""


class Conditional(NamedTuple):
    """Holds the affine model about paths if a number g' x_K of the last states is known."""

    P: Array
    """Covariances (trials, 1 + K, n, n)."""
    line: Array
    """How the path (trials, 1 + K, n) moves with the number."""
    size: Array
    """log det of the Hessian of J / 2 in start and noise, and of the number's variance
    (trials,)."""

    @classmethod
    def of(cls, density: PathDensity, at: Settled, tangents: Tangents, g: Array) -> Conditional:
        P, crossed, size = density.spread(tangents, at)
        c = np.matmul(crossed, g[:, None, :, None])[..., 0]
        variance = np.sum(g * c[:, -1], axis=1)
        line = c / variance[:, None, None]
        rest = P - c[..., :, None] * line[..., None, :]
        return cls(rest, line, size + np.log(variance))


@dataclass(frozen=True)
class Around:
    """Holds what the densities about paths are like."""

    P: Array
    """Covariances (trials, 1 + K, n, n) of the states, second moments about the paths where the
    density is not normal."""
    mass: Array
    """Integral of the density over that of the normal one of the affine model (trials,)."""
    log_determinant: Array
    """Of the Hessian of half the cost in start and noise (trials,), by the affine model."""
    calls: Array
    """Evaluations (trials,) that this took."""

    @classmethod
    def empty(cls, x: Array) -> Around:
        """Returns what is to be filled for paths x (trials, 1 + K, n)."""
        return cls(
            np.empty((*x.shape, x.shape[-1])), np.ones(len(x)), np.zeros(len(x)), np.zeros(len(x))
        )


def widened(density: PathDensity, at: Settled, tangents: Tangents) -> Around:
    """Computes what the densities about paths are like, and their covariances.

    Along each axis of the last states' covariance the path is moved by 3 deviations to both sides.
    Where the cost there is not that of a normal density, the axis on which it differs most is
    followed through points t: at each the rest of the path is that of largest density, and normal
    (Rue, Martino and Chopin, J. R. Stat. Soc. B 71, 2009: nested Laplace approximations). With
    means x(t), covariances P(t) and the Hessian H(t) of the rest,

        w(t) = exp(-J / 2) (det H)^-1/2,   P = sum w (P(t) + (x(t) - x(0)) (x(t) - x(0))') / sum w.
    """
    trials, _, n = at.x.shape
    out = Around.empty(at.x)
    axes = np.empty((trials, n, n))
    unlike = np.empty((trials, n))
    for i in _pieces(density, trials, 2 * n):
        found = _looked_at(density.subset(i), take(at, i), take(tangents, i))
        out.P[i], out.log_determinant[i], out.calls[i], axes[i], unlike[i] = found
    rows = np.flatnonzero(unlike.max(axis=1) > _NORMAL)
    for i in _pieces(density, len(rows), 2):
        here = rows[i]
        g = axes[here, unlike[here].argmax(axis=1)]
        found = _followed(density.subset(here), take(at, here), take(tangents, here), g)
        out.calls[here] += found.calls
        wider = _is_wider(found.P[:, -1], axes[here])
        out.P[here[wider]] = found.P[wider]
        out.mass[here[wider]] = found.mass[wider]
    return out


def _pieces(density: PathDensity, trials: int, paths: int) -> list[NDArray[np.intp]]:
    """Returns the trials that are held at once, with so many paths of each."""
    slopes = int(_NUMBERS / (density.model.n**2 * density.model.epochs))
    at_once = max(_LANES, slopes // paths)
    return np.split(np.arange(trials), range(at_once, trials, at_once))


class _Looked(NamedTuple):
    """Holds how the cost rises about paths."""

    P: Array
    """Covariances (trials, 1 + K, n, n) by the affine model."""
    log_determinant: Array
    calls: Array
    axes: Array
    """Inverse axes (trials, n, n) of the last states' covariance."""
    unlike: Array
    """Part of its rise (trials, n) along each by which the cost is not that of a normal density."""


def _looked_at(density: PathDensity, at: Settled, tangents: Tangents) -> _Looked:
    trials, epochs, n = at.x.shape
    P, crossed, size = density.spread(tangents, at)
    lines, axes = _lines(P[:, -1], crossed)
    sides = np.stack([lines, -lines], axis=1).reshape(-1, epochs, n)
    owner = np.repeat(np.arange(trials), 2 * n)
    moved = density.subset(owner).settled(at.x[owner] + _FAR * sides)
    calls = moved.calls.reshape(trials, 2 * n).sum(axis=1)
    # dJ / c^2 is 1 where the density is normal.
    rise = (moved.cost - at.cost[owner]).reshape(trials, 2, n) / _FAR**2
    unlike = np.abs(rise - 1.0).max(axis=1)
    known = (lines == 0).all(axis=(2, 3))
    return _Looked(P, size, calls, axes, np.where(known, 0.0, unlike))


def _is_wider(moment: Array, axes: Array) -> Mask:
    """Tells which second moments (trials, n, n) are at least the covariance of these axes, but for
    a little: a smaller one is that of points about which the rest of the path was not found."""
    whitened = np.matmul(np.matmul(axes, moment), transposed(axes))
    # An axis without variance, whose number is known, stays one.
    nothing = (axes == 0).all(axis=2)
    whitened[nothing, nothing.nonzero()[1]] = 1.0
    finite = np.isfinite(whitened).all(axis=(1, 2))
    whitened[~finite] = 0.0
    return np.linalg.eigvalsh(whitened)[:, 0] > _LEAST


def _lines(P: Array, crossed: Array) -> tuple[Array, Array]:
    """Computes how paths move (trials, n, 1 + K, n) where the last states do by a deviation along
    each axis of their covariance P, and the inverse of these axes (trials, n, n)."""
    _, inverse = principal(P)
    # cov(x_k, x_K) G^-' with P = G G', a row for each axis.
    lines = np.moveaxis(np.matmul(crossed, transposed(inverse)[:, None]), -1, 1)
    # But for round-off the last states move by one deviation already.
    along = np.sum(inverse * lines[:, :, -1], axis=-1)
    return lines / np.where(along > 0, along, 1.0)[..., None, None], inverse


def _followed(density: PathDensity, at: Settled, tangents: Tangents, g: Array) -> Around:
    """Computes the second moments about paths and their mass by the points of an axis on which g'
    x_K (trials, n) of the last states has unit variance."""
    trials = len(at.x)
    middle = Conditional.of(density, at, tangents, g)
    of_tangents = Taylor().calls(density.model.n) * density.model.evaluations
    # Each side by itself: which of them comes first is the sign of an axis, which is round-off.
    owner = np.tile(np.arange(trials), 2)
    sign = np.repeat([1.0, -1.0], trials)
    # Sums over the points of a side, and the sides that still go on, with their last path.
    moment = np.zeros((2 * trials, *middle.P.shape[1:]))
    total = np.zeros(2 * trials)
    calls = np.zeros(2 * trials)
    rows = np.arange(2 * trials)
    x = at.x[owner]
    line = middle.line[owner]
    for number in range(1, _POINTS + 1):
        own = owner[rows]
        # g' x_K is to be t deviations from where it was; the path comes along as at the last point.
        t = sign[rows] * _STRIDE * number
        some = density.subset(own)
        begun = some.settled(x + sign[rows, None, None] * _STRIDE * line)
        about = some.tangents(begun)
        here = Conditional.of(some, begun, about, g[own])
        # The rest of the path follows by a step of the affine model, g' x_K by none.
        step = some.step(about, begun)
        last = begun.x[:, -1] + step[:, -1] - at.x[own, -1]
        over = np.sum(g[own] * last, axis=1) - t
        there = some.settled(begun.x + step - over[:, None, None] * here.line)
        calls[rows] += begun.calls + there.calls + of_tangents
        # The second moment about the first path, and how much it weighs.
        d = density.model.nearest_state(there.x, at.x[own]) - at.x[own]
        second = here.P + d[..., :, None] * d[..., None, :]
        fall = at.cost[own] - there.cost + middle.size[own] - here.size
        weight = np.exp(np.minimum(fall / 2, _MOST))
        counted = np.isfinite(second).all(axis=(1, 2, 3)) & np.isfinite(weight)
        weight = np.where(counted, weight, 0.0)
        second = np.where(counted[:, None, None, None], second, 0.0)
        total[rows] += weight
        moment[rows] += weight[:, None, None, None] * second
        # A side ends where the tail behind its point is little.
        going = weight * t**2 > _LITTLE * (1.0 + total[rows])
        if not going.any():
            break
        rows = rows[going]
        x = there.x[going]
        line = here.line[going]
    moments = middle.P + moment[:trials] + moment[trials:]
    mass = 1.0 + total[:trials] + total[trials:]
    of_both = calls[:trials] + calls[trials:]
    return Around(moments / mass[:, None, None, None], mass / _OF_NORMAL, middle.size, of_both)
