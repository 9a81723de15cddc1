"""Smoothers of state models: every epoch is estimated from all readings, by passes back through a filter's tracks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.basics.options import Count, NonNegative
from ipe_bench.states.algebra import divide, mahalanobis, symmetric, transposed
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.linearisation import Rule, Taylor
from ipe_bench.states.trackers import Filter, Tracker, Tracks, filtered, misfit

_HALVINGS = 12
"""Halvings of a damped step."""


@dataclass(frozen=True)
class Smoother(Tracker):
    """The smoother of Rauch, Tung and Striebel (AIAA J. 3, 1965) behind a filter."""

    filter: Filter = field(default_factory=Filter)
    """The filter whose tracks are smoothed."""

    def track(self, model: StateModel, z: Array) -> Tracks:
        return smoothed(model, self.filter.track(model, z))


@dataclass(frozen=True)
class IteratedSmoother(Tracker):
    """Linearises everything about the last smoothed path and solves that affine problem exactly, again and again.

    By Taylor's rule these are Gauss-Newton steps to the path of largest posterior density (Bell, SIAM J. Optim. 4,
    1994), with `damped` halved while they raise its cost; by sigma points it is the iterated posterior linearisation
    smoother (García-Fernández, Svensson, Särkkä, IEEE TSP 65, 2017). The first path is that of `first`, smoothed.
    """

    first: Filter = field(default_factory=Filter)
    """The filter whose smoothed tracks are the first path."""
    rule: Rule = field(default_factory=Taylor)
    """How transition and reading are linearised about a path."""
    iterations: Count = 10
    """Paths at most, after the first."""
    damped: bool = False
    """Whether steps that raise the cost of the path are halved; for Taylor's rule."""
    tolerance: NonNegative = 0.0
    """Ends where no trial's path moves by more than so many of its own standard deviations."""

    def track(self, model: StateModel, z: Array) -> Tracks:
        path = self.first.track(model, z)
        calls, going = path.calls, np.ones(len(z), dtype=bool)
        for _ in range(self.iterations):
            new = smoothed(model, filtered(model, z, self.rule, path=path))
            if self.damped:
                new = _shortened(model, z, path, new)
            calls = calls + np.where(going, new.calls, 0.0)
            moved = np.abs(new.mean - path.mean) / np.sqrt(np.diagonal(new.covariance, axis1=-2, axis2=-1))
            path, on = new, (moved > self.tolerance).any(axis=(1, 2))
            going &= on
            if not on.any():
                break
        path.calls = calls
        return path


def smoothed(model: StateModel, tracks: Tracks) -> Tracks:
    """Passes back through a filter's tracks to before the first transition (Rauch, Tung, Striebel, AIAA J. 3, 1965):

        G = P[k] A' (A P[k] A' + W + Q)^-1
        m[k] <- m[k] + G (m[k+1] - m-[k+1])
        P[k] <- P[k] + G (P[k+1] - P-[k+1]) G'

    with m-[k+1] and P-[k+1] predicted from epoch k by the affine law A of its transition.
    """
    out = Tracks.empty(model, len(tracks.mean))
    out.mean[:, -1], out.covariance[:, -1] = x = tracks.at(model.epochs - 1)
    first = 0 if model.moved_first else 1
    for k in range(model.epochs - 1, first - 1, -1):
        before = tracks.at(k - 1)
        move, predicted = tracks.moves[k - first], tracks.predicted[k - first]
        G = divide(np.matmul(before.covariance, transposed(move.A)), predicted.covariance)
        P = np.matmul(np.matmul(G, x.covariance - predicted.covariance), transposed(G))
        x = Normal(before.mean + multiply(G, x.mean - predicted.mean), symmetric(before.covariance + P))
        if k:
            out.mean[:, k - 1], out.covariance[:, k - 1] = x
    out.start = x
    out.moves, out.predicted, out.calls = tracks.moves, tracks.predicted, tracks.calls
    return out


def path_cost(model: StateModel, z: Array, start: Array, mean: Array) -> Array:
    """-2 log p(path | readings) (trials,) up to a constant; disturbances count by the pseudo-inverse of the gain."""
    total, before = mahalanobis(start - model.prior.mean, model.prior.covariance), start
    for k in range(model.epochs):
        if model.moves(k):
            w = multiply(np.linalg.pinv(model.gain(k)), mean[:, k] - model.transition(before, k))
            total = total + np.sum(w**2, axis=-1)
        total, before = total + misfit(model, z[:, k], mean[:, k, None], k)[0][:, 0], mean[:, k]
    return total


def _halved(old: Array, new: Array, cost: Callable[[Array], Array]) -> tuple[Array, Array]:
    """The step from `old` to `new` (trials, ...), halved in each trial until the cost (trials,) is not above that of
    `old`; and how many costs (trials,) that took."""
    best, share = cost(old), np.ones((len(old),) + (1,) * (old.ndim - 1))
    worse, taken = np.ones(len(old), dtype=bool), np.ones(len(old))
    for _ in range(_HALVINGS):
        taken += worse
        worse = ~(cost(old + share * (new - old)) <= best * (1 + 1e-12))
        if not worse.any():
            break
        share[worse] /= 2
    return old + share * (new - old), taken


def _shortened(model: StateModel, z: Array, old: Tracks, new: Tracks) -> Tracks:
    """The step from one path to the next, halved where it raises the path's cost."""
    first, last = (np.concatenate([path.start.mean[:, None], path.mean], axis=1) for path in (old, new))
    path, costs = _halved(first, last, lambda x: path_cost(model, z, x[:, 0], x[:, 1:]))
    new.calls = new.calls + costs * model.evaluations
    new.mean, new.start = path[:, 1:], Normal(path[:, 0], new.start.covariance)
    return new
