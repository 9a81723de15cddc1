"""The exact answer for a scalar state: its density at the points of a grid (Kitagawa, JASA 82, 1987)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.basics.options import Count
from ipe_bench.states.base import StateModel
from ipe_bench.states.particles import weighed
from ipe_bench.states.trackers import Tracker, Tracks

_PATHS = 1000
"""Drawn paths by which the grid of an epoch is as wide as the states are."""
_BEYOND = 3.0
"""Their standard deviations by which it is wider on either side."""
_COARSE = 1.6
"""Largest squared step of the points in standard deviations of process noise, and of the density about its peak: an
integral is then wrong by a share of exp(-2 pi^2 / 1.6) = 4e-6."""
_AT_ONCE = 25
"""Trials that are smoothed at once."""
_CUT = 1e-6
"""Largest density at an end of the grid, in parts of the peak."""


@dataclass(frozen=True)
class Grid(Tracker):
    """The exact mean and variance of a scalar state, which no tracker beats in mean square.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/growth", count=8)
    >>> trackers = {"ekf": ib.states.ekf(), "grid": ib.states.Grid(points=800)}
    >>> table = ib.run(model, trackers, trials=20)
    >>> rmse = table[table["parameter"] == "all"].set_index("estimator")["rmse"]
    >>> bool(rmse["grid"] < rmse["ekf"])
    True
    """

    points: Count = 1000
    """Points of the grid of an epoch."""
    smooths: bool = False
    """Whether each epoch is estimated from all readings instead of those up to it."""

    def hindrance(self, model: StateModel) -> str | None:
        if model.n > 1:
            return f"is exact for one state, and {model.name} has {model.n}; leave it out"
        if model.state_periods:
            return f"has no place for a periodic state, as in {model.name}; leave it out"
        grids, epochs = self._grids(model), [k for k in range(model.epochs) if model.moves(k)]
        noise = np.sqrt([_COARSE * _variances(model, grids, k).min() for k in epochs])
        if not (noise > 0).all():
            return f"needs process noise at every step of {model.name}; leave it out"
        steps = [
            max(np.diff(grids[k + 1]).max(), np.abs(np.diff(_moved(model, grids, k))).max())
            for k in epochs
        ]
        if (excess := np.max(steps / noise)) > 1:
            needed = math.ceil(1.1 * self.points * excess)
            # The moves of so coarse a grid hardly tell how fine it has to be: the finer one is asked, too.
            remedy = f"set trackers.LABEL.points={needed}"
            finer = replace(self, points=needed).hindrance(model)
            return finer or f"its points are farther apart than process noise reaches; {remedy}"
        return None

    def track(self, model: StateModel, z: Array) -> Tracks:
        if self.smooths and len(z) > _AT_ONCE:  # whose densities are kept for all epochs
            return Tracks.join(
                [self.track(model, z[i : i + _AT_ONCE]) for i in range(0, len(z), _AT_ONCE)]
            )
        out, grids = Tracks.empty(model, len(z)), self._grids(model)
        again = (model.epochs - 1) * self.smooths  # transitions on the way back
        out.calls += (self.points + _PATHS) * model.evaluations + self.points * again
        m, P = model.prior.mean[0], model.prior.covariance[0, 0]
        p = np.exp(-0.5 * (grids[0] - m) ** 2 / (P or 1.0))
        p = np.repeat(p[None] / p.sum(), len(z), axis=0)
        kept = []
        for k in range(model.epochs):
            if model.moves(k):
                p = multiply(_kernel(model, grids, k), p)
                p /= p.sum(axis=1, keepdims=True)
            predicted = p
            p = weighed(
                model, np.repeat(grids[k + 1][None, :, None], len(z), 0), k, z[:, k], p, out
            )
            _require_resolved(p, k)
            _describe(out, k, p, grids)
            if self.smooths:
                kept.append((predicted, p))
        for k in range(len(kept) - 2, -1, -1):
            predicted = kept[k + 1][0]
            ratio = np.where(predicted > 0, p / np.maximum(predicted, 1e-300), 0.0)
            p = kept[k][1] * multiply(_kernel(model, grids, k + 1).T, ratio)
            p /= p.sum(axis=1, keepdims=True)
            _describe(out, k, p, grids)
        return out

    def _grids(self, model: StateModel) -> Array:
        """The points (K + 1, points) before the first transition, and at each epoch."""
        paths = StateModel.draw(model, 0, _PATHS)
        x = np.concatenate([paths.start, paths.x[..., 0]], axis=1)
        margin = _BEYOND * x.std(axis=0)
        return np.linspace(x.min(axis=0) - margin, x.max(axis=0) + margin, self.points, axis=1)


def _kernel(model: StateModel, grids: Array, k: int) -> Array:
    """The probability (points, points) of each point of epoch k, up to a factor, from each of the epoch before."""
    Q = _variances(model, grids, k)
    p = np.exp(-0.5 * (grids[k + 1][:, None] - _moved(model, grids, k)) ** 2 / Q)
    return p / np.sqrt(Q) if model.gain_by_state else p


def _variances(model: StateModel, grids: Array, k: int) -> Array:
    """The variance of the process noise into epoch k: of all points (), or from each of those before it (points,)."""
    return model.Q_at(grids[k][:, None], k)[..., 0, 0]


def _moved(model: StateModel, grids: Array, k: int) -> Array:
    """Returns the points before epoch k, moved to it without process noise (points,)."""
    return model.transition_into(k)(grids[k][:, None])[:, 0]


def _describe(out: Tracks, k: int, p: Array, grids: Array) -> None:
    """Notes the mean and the variance of the densities p (trials, points) of epoch k."""
    g = grids[k + 1]
    out.mean[:, k, 0] = mean = np.sum(p * g, axis=1)
    out.covariance[:, k, 0, 0] = np.sum(p * (g - mean[:, None]) ** 2, axis=1)


def _require_resolved(p: Array, k: int) -> None:
    """Refuses densities p (trials, points) that fall between points, or run over an end."""
    rows, peak = np.arange(len(p)), p.argmax(axis=1).clip(1, p.shape[1] - 2)
    bend = np.log(p[rows, peak] ** 2 / np.maximum(p[rows, peak - 1] * p[rows, peak + 1], 1e-300))
    ends = np.maximum(p[:, 0], p[:, -1]) / p[rows, peak]
    if not (bend < _COARSE).all():
        raise ArithmeticError(
            f"the density of epoch {k + 1} falls between the points of the grid; set more points"
        )
    if not (ends < _CUT).all():
        raise ArithmeticError(
            f"the density of epoch {k + 1} runs over an end of the grid: the model draws no such path"
        )
