"""The exact answer for a scalar state: its density at the points of a grid (Kitagawa, JASA 82,
1987)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

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
"""Largest squared step of the points in standard deviations of process noise, and of the density
about its peak: an integral is then wrong by a share of exp(-2 pi^2 / 1.6) = 4e-6."""
_AT_ONCE = 25
"""Trials that are smoothed at once."""
_CUT = 1e-6
"""Largest density at an end of the grid, in parts of the peak."""
_TINY = 1e-300
"""What a density is divided by at least."""
_MOST_POINTS = 10_000
"""Points of an epoch beyond which none are asked for: their kernel takes 0.8 GB."""


@dataclass(frozen=True)
class Grid(Tracker):
    """The exact mean and variance of a scalar state, which no tracker beats in mean square.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/growth", count=8)
    >>> trackers = {"ekf": ib.states.ekf(), "grid": ib.states.Grid(points=800)}
    >>> table = ib.run(model, trackers, trials=20)
    >>> rmse = table[table["parameter"] == "all"].set_index("estimator")["rmse_solved"]
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
        if self.points < 3:
            return "needs three points at least; leave trackers.LABEL.points out"
        grids = self._grids(model)
        epochs = [k for k in range(model.epochs) if model.moves(k)]
        # The widest step that process noise still bridges, of each epoch.
        allowed = np.sqrt([_COARSE * _variances(model, grids, k).min() for k in epochs])
        if not (allowed > 0).all():
            return f"needs process noise at every step of {model.name}; leave it out"
        steps = [_widest_step(model, grids, k) for k in epochs]
        excess = np.max(steps / allowed, initial=0.0)
        if not excess > 1:
            return None
        least = 1.1 * self.points * excess
        if least > _MOST_POINTS:
            return (
                f"would need {least:.2g} points for the process noise of {model.name}, above"
                f" {_MOST_POINTS}; leave it out"
            )
        needed = math.ceil(least)
        # The moves of so coarse a grid hardly tell how fine it has to be: the finer one is asked.
        finer = replace(self, points=needed).hindrance(model)
        if finer:
            return finer
        return (
            "its points are farther apart than process noise reaches; "
            f"set trackers.LABEL.points={needed}"
        )

    def track(self, model: StateModel, z: Array) -> Tracks:
        # A smoother keeps the densities of all epochs.
        if self.smooths and len(z) > _AT_ONCE:
            parts = np.split(z, range(_AT_ONCE, len(z), _AT_ONCE))
            return Tracks.join([self.track(model, part) for part in parts])
        out = Tracks.empty(model, len(z))
        grids = self._grids(model)
        out.calls += (self.points + _PATHS) * model.evaluations
        filtered = self._filtered(model, grids, z, out)
        if self.smooths:
            # The way back moves the points once more.
            out.calls += self.points * (model.epochs - 1)
            _smooth(model, grids, filtered, out)
        return out

    def _filtered(self, model: StateModel, grids: Array, z: Array, out: Tracks) -> list[_Densities]:
        """Runs the filter forward; the densities of each epoch are for a smoother alone."""
        m, P = model.prior
        # A start that is known exactly has a grid of one and the same point.
        start = np.exp(-0.5 * (grids[0] - m) ** 2 / (P[0, 0] or 1.0))
        p = np.repeat(start[None] / start.sum(), len(z), axis=0)
        kept: list[_Densities] = []
        for k in range(model.epochs):
            # Prediction: p(x_k | z_1..k-1) = integral of p(x_k | x) p(x | z_1..k-1) dx
            if model.moves(k):
                p = _normalised(multiply(_kernel(model, grids, k), p))
            predicted = p
            # Update: p(x_k | z_1..k) ~ p(z_k | x_k) p(x_k | z_1..k-1)
            x = np.repeat(grids[k + 1][None, :, None], len(z), axis=0)
            p = weighed(model, x, k, z[:, k], predicted, out)
            _require_resolved(p, k)
            _describe(out, k, p, grids)
            if self.smooths:
                kept.append(_Densities(predicted, p))
        return kept

    def _grids(self, model: StateModel) -> Array:
        """Returns the points (K + 1, points) before the first transition, and at each epoch."""
        paths = StateModel.draw(model, 0, _PATHS)
        x = np.concatenate([paths.start, paths.x[..., 0]], axis=1)
        margin = _BEYOND * x.std(axis=0)
        return np.linspace(x.min(axis=0) - margin, x.max(axis=0) + margin, self.points, axis=1)


class _Densities(NamedTuple):
    """Holds what is known of the states of an epoch."""

    predicted: Array
    """Probabilities (trials, points) before its readings."""
    filtered: Array
    """Probabilities (trials, points) after them."""


def _smooth(model: StateModel, grids: Array, kept: list[_Densities], out: Tracks) -> None:
    """Passes back from the last epoch (Kitagawa, 1987):

    p(x_k | z) = p(x_k | z_1..k) integral of p(x_k+1 | x_k) p(x_k+1 | z) / p(x_k+1 | z_1..k) dx_k+1
    """
    p = kept[-1].filtered
    for k in range(model.epochs - 2, -1, -1):
        predicted = kept[k + 1].predicted
        # Points that were impossible stay so.
        ratio = np.where(predicted > 0, p / np.maximum(predicted, _TINY), 0.0)
        p = _normalised(kept[k].filtered * multiply(_kernel(model, grids, k + 1).T, ratio))
        _describe(out, k, p, grids)


def _normalised(p: Array) -> Array:
    return p / p.sum(axis=1, keepdims=True)


def _kernel(model: StateModel, grids: Array, k: int) -> Array:
    """Computes the probability (points, points) of each point of epoch k, up to a factor, from each
    of the epoch before."""
    Q = _variances(model, grids, k)
    # N(x_k; f(x), Q(x)); what all columns share drops out of the sums.
    d = grids[k + 1][:, None] - _moved(model, grids, k)
    p = np.exp(-0.5 * d**2 / Q)
    return p / np.sqrt(Q) if model.gain_by_state else p


def _variances(model: StateModel, grids: Array, k: int) -> Array:
    """Returns the variance of the process noise into epoch k: of all points (), or from each of
    those before it (points,)."""
    return model.Q_at(grids[k][:, None], k)[..., 0, 0]


def _moved(model: StateModel, grids: Array, k: int) -> Array:
    """Returns the points before epoch k, moved to it without process noise (points,)."""
    return model.transition_into(k)(grids[k][:, None])[:, 0]


def _widest_step(model: StateModel, grids: Array, k: int) -> float:
    """Returns the widest step between points of epoch k, and between those before it once moved."""
    own = np.diff(grids[k + 1])
    moved = np.diff(_moved(model, grids, k))
    return max(own.max(), np.abs(moved).max())


def _describe(out: Tracks, k: int, p: Array, grids: Array) -> None:
    """Notes the mean and the variance of the densities p (trials, points) of epoch k."""
    x = grids[k + 1]
    mean = np.sum(p * x, axis=1)
    out.mean[:, k, 0] = mean
    out.covariance[:, k, 0, 0] = np.sum(p * (x - mean[:, None]) ** 2, axis=1)


def _require_resolved(p: Array, k: int) -> None:
    """Refuses densities p (trials, points) that fall between points, or run over an end."""
    rows = np.arange(len(p))
    at = p.argmax(axis=1).clip(1, p.shape[1] - 2)
    peak = p[rows, at]
    # The second difference of -log p: squared steps in standard deviations about the peak.
    beside = p[rows, at - 1] * p[rows, at + 1]
    bend = np.log(peak**2 / np.maximum(beside, _TINY))
    if not (bend < _COARSE).all():
        raise ArithmeticError(
            f"the density of epoch {k + 1} falls between the points of the grid; set more points"
        )
    ends = np.maximum(p[:, 0], p[:, -1]) / peak
    if not (ends < _CUT).all():
        raise ArithmeticError(
            f"the density of epoch {k + 1} runs over an end of the grid: "
            "the model draws no such path"
        )
