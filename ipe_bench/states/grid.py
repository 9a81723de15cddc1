"""The exact answer for a scalar state: its density at the points of a grid (Kitagawa, JASA 82,
1987)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import gather, take
from ipe_bench.basics.linalg import Array, Mask, multiply
from ipe_bench.basics.options import Count, Quantile
from ipe_bench.states.base import StateModel
from ipe_bench.states.particles import weighed
from ipe_bench.states.passes import kept_of
from ipe_bench.states.trackers import Tracker, Tracks

_PATHS = 200
"""Drawn paths by which the grid of an epoch is as wide as the states are."""
_BEYOND = 4.0
"""Their standard deviations by which it is wider on either side at first."""
_COARSE = 1.6
"""Largest squared step of the points in standard deviations of process noise, and of the density
about its peak: an integral is then wrong by a share of exp(-2 pi^2 / 1.6) = 4e-6. At a kink of a
reading, as of |x|, the error falls with the squared step alone: a deviation there was 2.5 % off
with 200 points, and 0.2 % with 1,000 (posterior of x' = 0.95 x + 0.5 w, z = |x| + 0.3 v)."""
_AT_ONCE = 50
"""Trials that are smoothed at once."""
_CUT = 1e-6
"""Largest density at an end of the grid, in parts of the peak."""
_TINY = 1e-300
"""What a density is divided by at least."""
_MOST_POINTS = 5_000
"""Points of an epoch beyond which none are asked for: their kernel takes 0.2 GB."""


class _Extent(NamedTuple):
    """Says where the points of an epoch lie."""

    points: int
    beyond: float
    """Standard deviations of drawn states by which they lie beyond these on either side."""


@dataclass(frozen=True)
class Grid(Tracker):
    """The exact mean and variance of a scalar state, which no tracker beats in mean square.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/growth", count=8)
    >>> trackers = {"ekf": ib.states.ekf(), "grid": ib.states.Grid()}
    >>> table = ib.run(model, trackers, trials=20)
    >>> rmse = table[table["parameter"] == "all"].set_index("estimator")["rmse_solved"]
    >>> bool(rmse["grid"] < rmse["ekf"])
    True
    """

    points: Count = 1000
    """Points of the grid of an epoch."""
    smooths: bool = False
    """Whether each epoch is estimated from all readings instead of those up to it."""
    gate: Quantile | None = None
    """A reading counts as missing if a farther one has less than 1 less this probability, such as
    0.999, by the density that is predicted."""

    def hindrance(self, model: StateModel) -> str | None:
        if self.points < 3:
            return "needs three points at least; leave trackers.LABEL.points out"
        fitting = self.fitting(model)
        if isinstance(fitting, str):
            return fitting
        if fitting.points == self.points:
            return None
        return (
            "its points are farther apart than the noise of states or readings reaches; "
            f"set trackers.LABEL.points={fitting.points}"
        )

    def fitting(self, model: StateModel) -> Grid | str:
        """Returns the grid of as many points as the model needs, these at least, or why none is
        exact for it, in words that follow the tracker's label. A model is asked once, which is no
        cost of a trial."""
        kept = kept_of(model)
        if self not in kept:
            kept[self] = self._fitting(model)
        return kept[self]

    def _fitting(self, model: StateModel) -> Grid | str:
        if model.n > 1:
            return f"is exact for one state, and {model.name} has {model.n}; leave it out"
        if model.state_periods:
            return f"has no place for a periodic state, as in {model.name}; leave it out"
        drawn = _drawn(model)
        grids = _grids(drawn, _Extent(self.points, _BEYOND))
        # The least process noise of each epoch has to bridge steps.
        noise = [_variances(model, grids, k).min() for k in range(model.epochs) if model.moves(k)]
        if not (np.array(noise) > 0).all():
            return f"needs process noise at every step of {model.name}; leave it out"
        try:
            widest = max(_squared_step(model, grids, drawn, k) for k in range(model.epochs))
        except np.linalg.LinAlgError:
            return f"needs noise in every reading of {model.name}; leave it out"
        excess = math.sqrt(widest / _COARSE)
        if not excess > 1:
            return self
        needed = 1.02 * self.points * excess
        if needed > _MOST_POINTS:
            return (
                f"would need {needed:.2g} points for the noise of {model.name}, above"
                f" {_MOST_POINTS}; leave it out"
            )
        # The moves of so coarse a grid hardly tell how fine it has to be: the finer one is asked.
        return replace(self, points=math.ceil(needed)).fitting(model)

    def track(self, model: StateModel, z: Array) -> Tracks:
        # A smoother keeps the densities of all epochs.
        if self.smooths and len(z) > _AT_ONCE:
            parts = np.split(z, range(_AT_ONCE, len(z), _AT_ONCE))
            return Tracks.join([self.track(model, part) for part in parts])
        return self._tracked(model, z, _Extent(self.points, _BEYOND))

    def _tracked(self, model: StateModel, z: Array, extent: _Extent) -> Tracks:
        """Tracks each trial by points of an extent, or by more where its density asks for them."""
        tracks, faults = self._by(_Steps.of(model, extent), z)
        paid = extent.points * model.evaluations
        finer = extent._replace(points=2 * extent.points)
        wider = finer._replace(beyond=2 * extent.beyond)
        parts = [(np.arange(len(z)), tracks)]
        for bad, more in ((faults.coarse, finer), (faults.beyond, wider)):
            rows = np.flatnonzero(bad)
            if not rows.size:
                continue
            if more.points > _MOST_POINTS:
                raise ArithmeticError(faults.text(rows[0]))
            again = self._tracked(model, z[rows], more)
            again.calls += paid
            parts.append((rows, again))
        good = np.flatnonzero(~(faults.coarse | faults.beyond))
        parts[0] = good, take(tracks, good)
        return gather(parts)

    def _by(self, steps: _Steps, z: Array) -> tuple[Tracks, _Faults]:
        """Runs the filter forward, and the smoother back; tells which trials these points do not
        suit."""
        model = steps.model
        out = Tracks.empty(model, len(z))
        out.calls += steps.grids.shape[1] * model.evaluations
        faults = _Faults.none(len(z))
        m, P = model.prior
        # A start that is known exactly has a grid of one and the same point.
        start = np.exp(-0.5 * (steps.grids[0] - m) ** 2 / (P[0, 0] or 1.0))
        p = np.repeat(start[None] / start.sum(), len(z), axis=0)
        kept: list[_Densities] = []
        for k in range(model.epochs):
            # Prediction: p(x_k | z_1..k-1) = integral of p(x_k | x) p(x | z_1..k-1) dx
            if model.moves(k):
                p = _normalised(multiply(steps.kernel(k), p))
            predicted = p
            # Update: p(x_k | z_1..k) ~ p(z_k | x_k) p(x_k | z_1..k-1)
            x = np.repeat(steps.grids[k + 1][None, :, None], len(z), axis=0)
            p = weighed(model, x, k, z[:, k], predicted, out, self.gate)
            faults.note(p, k)
            _describe(out, k, p, steps.grids)
            if self.smooths:
                kept.append(_Densities(predicted, p))
        if self.smooths:
            _smooth(steps, kept, out)
        return out, faults


@dataclass
class _Faults:
    """Holds which trials the points of a grid do not suit."""

    coarse: Mask
    """Whose density falls between the points (trials,)."""
    beyond: Mask
    """Whose density runs over an end (trials,)."""
    epoch: NDArray[np.int64]
    """The first such epoch k (trials,)."""

    @classmethod
    def none(cls, trials: int) -> _Faults:
        nothing = np.zeros(trials, dtype=bool)
        return cls(nothing, nothing.copy(), np.zeros(trials, np.int64))

    def note(self, p: Array, k: int) -> None:
        """Notes what is wrong with the densities p (trials, points) of epoch k, which become even
        ones: what follows of such a trial says nothing, and has to go on."""
        rows = np.arange(len(p))
        at = p.argmax(axis=1).clip(1, p.shape[1] - 2)
        peak = p[rows, at]
        # The second difference of -log p: squared steps in standard deviations about the peak.
        beside = p[rows, at - 1] * p[rows, at + 1]
        bend = np.log(np.maximum(peak**2, _TINY) / np.maximum(beside, _TINY))
        noted = self.coarse | self.beyond
        coarse = ~noted & ~(bend < _COARSE)
        beyond = ~noted & ~coarse & ~(np.maximum(p[:, 0], p[:, -1]) < _CUT * peak)
        self.coarse |= coarse
        self.beyond |= beyond
        self.epoch[coarse | beyond] = k
        p[self.coarse | self.beyond] = 1 / p.shape[1]

    def text(self, trial: int) -> str:
        """Says what is wrong with a trial."""
        density = f"the density of epoch {self.epoch[trial] + 1}"
        if self.coarse[trial]:
            return f"{density} falls between the points of the grid, {_MOST_POINTS} at most"
        return f"{density} runs over an end of the grid: the model draws no such path"


def _drawn(model: StateModel) -> Array:
    """Draws states (paths, K + 1) before the first transition, and at each epoch, once for a
    model."""
    kept = kept_of(model)
    if "drawn" not in kept:
        paths = StateModel.draw(model, 0, _PATHS)
        kept["drawn"] = np.concatenate([paths.start, paths.x[..., 0]], axis=1)
    return kept["drawn"]


def _grids(drawn: Array, extent: _Extent) -> Array:
    """Returns the points (K + 1, points) before the first transition, and at each epoch, as far as
    drawn states (paths, K + 1) are."""
    margin = extent.beyond * drawn.std(axis=0)
    least = drawn.min(axis=0) - margin
    return np.linspace(least, drawn.max(axis=0) + margin, extent.points, axis=1)


@dataclass(frozen=True)
class _Steps:
    """Holds how probability moves from the points of one epoch to those of the next."""

    model: StateModel
    grids: Array
    """Points (K + 1, points) before the first transition, and at each epoch."""
    moved: list[Array | None]
    """The points (points,) before each epoch, moved to it without process noise; None where no
    transition leads into it."""

    @classmethod
    def of(cls, model: StateModel, extent: _Extent) -> _Steps:
        grids = _grids(_drawn(model), extent)
        moved = [_moved(model, grids, k) if model.moves(k) else None for k in range(model.epochs)]
        return cls(model, grids, moved)

    def kernel(self, k: int) -> Array:
        """Computes the probability (points, points) of each point of epoch k, up to a factor, from
        each of the epoch before."""
        Q = _variances(self.model, self.grids, k)
        # N(x_k; f(x), Q(x)); what all columns share drops out of the sums.
        d = self.grids[k + 1][:, None] - self.moved[k]
        p = np.exp(-0.5 * d**2 / Q)
        return p / np.sqrt(Q) if self.model.gain_by_state else p


class _Densities(NamedTuple):
    """Holds what is known of the states of an epoch."""

    predicted: Array
    """Probabilities (trials, points) before its readings."""
    filtered: Array
    """Probabilities (trials, points) after them."""


def _smooth(steps: _Steps, kept: list[_Densities], out: Tracks) -> None:
    """Passes back from the last epoch (Kitagawa, 1987):

    p(x_k | z) = p(x_k | z_1..k) integral of p(x_k+1 | x_k) p(x_k+1 | z) / p(x_k+1 | z_1..k) dx_k+1
    """
    p = kept[-1].filtered
    for k in range(len(kept) - 2, -1, -1):
        predicted = kept[k + 1].predicted
        # Points that were impossible stay so.
        ratio = np.where(predicted > 0, p / np.maximum(predicted, _TINY), 0.0)
        p = _normalised(kept[k].filtered * multiply(steps.kernel(k + 1).T, ratio))
        _describe(out, k, p, steps.grids)


def _normalised(p: Array) -> Array:
    return p / p.sum(axis=1, keepdims=True)


def _variances(model: StateModel, grids: Array, k: int) -> Array:
    """Returns the variance of the process noise into epoch k: of all points (), or from each of
    those before it (points,)."""
    return model.Q_at(grids[k][:, None], k)[..., 0, 0]


def _moved(model: StateModel, grids: Array, k: int) -> Array:
    """Returns the points before epoch k, moved to it without process noise (points,)."""
    return model.transition_into(k)(grids[k][:, None])[:, 0]


def _squared_step(model: StateModel, grids: Array, drawn: Array, k: int) -> float:
    """Returns the widest squared step between points of epoch k, in deviations of a density there
    by process noise and readings, or between those before it once moved, by process noise alone;
    readings count where paths were drawn (paths, K + 1)."""
    points = grids[k + 1]
    own = (points[1] - points[0]) ** 2
    by_noise = moved = 0.0
    if model.moves(k):
        Q = _variances(model, grids, k).min()
        by_noise = own / Q
        moved = np.max(np.diff(_moved(model, grids, k)) ** 2) / Q
    x = drawn[:, k + 1, None]
    two = np.stack([x, x + points[1] - points[0]], axis=1)
    h = model.observation_at(k)(two)
    apart = model.nearest(h[:, 1], h[:, 0]) - h[:, 0]
    R = model.R_at(two[:, 0], k)
    by_readings = np.sum(apart * np.linalg.solve(R, apart[..., None])[..., 0], axis=1)
    return max(moved, by_noise + by_readings.max())


def _describe(out: Tracks, k: int, p: Array, grids: Array) -> None:
    """Notes the mean and the variance of the densities p (trials, points) of epoch k."""
    x = grids[k + 1]
    mean = np.sum(p * x, axis=1)
    out.mean[:, k, 0] = mean
    out.covariance[:, k, 0, 0] = np.sum(p * (x - mean[:, None]) ** 2, axis=1)
