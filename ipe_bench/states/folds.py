"""Tells where a filter by tangents misleads itself, since a reading turns back or comes round among
the states that it predicts, hardly rises any more, or has other noise; the exact density is known
there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import take
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.states.base import StateModel
from ipe_bench.states.grid import Grid
from ipe_bench.states.smoothers import whole
from ipe_bench.states.trackers import Filter, Tracks

_AMONG = np.linspace(-2.0, 2.0, 5)
"""Where readings are looked at, in standard deviations of what is predicted."""
_EVEN = 0.2
"""Part of its steepest rise between these points that a reading has between all of them, unless it
is folded."""
_SEEN = 1.0
"""Standard deviations of a reading that its steepest rise is at least, if it tells of the state."""
_NOISES = 3.0
"""How many times the least standard deviation of a reading at these points the largest may be."""
_ROUND = 0.6
"""Part of its period through which a reading that comes round goes between these points at least:
states a period apart are then 6.7 standard deviations apart at most, and both may be probable."""
_POINTS = 200
"""Points of the grid of an epoch at least; as many take half a millisecond a trial of 20 epochs, a
fine one may take a second."""
_WORK = 1e7
"""Products of points and points and epochs of a trial up to which finer grids are taken, too: some
20 ms. Models that need more are so precise that their posteriors are nearly those of tangents."""
_STRAIGHT = 1e-9
"""Part by which slopes of a straight line differ at most."""


def may_fold(model: StateModel) -> bool:
    """Tells whether a model has a scalar state, which has no period."""
    return model.n == 1 and not any(model.state_periods)


def exact_tracks(
    model: StateModel,
    z: Array,
    filtered: Tracks,
    smooths: bool = True,
    gate: float | None = None,
    *,
    of_all: bool = False,
) -> tuple[Tracks, NDArray[np.intp]]:
    """Returns the tracks of a grid of those trials whose readings are folded among the states that
    the extended filter predicts, if a grid is exact for them, and which trials these are; readings
    beyond a quantile `gate` are missing. `of_all` asks for all trials of a model that is not
    straight and whose grid is no work."""
    if not may_fold(model):
        return Tracks.empty(model, 0), np.arange(0)
    is_open = folded(model, filtered)
    if Filter().hindrance(model):
        # A filter takes nothing from such readings.
        is_open[:] = True
    if of_all and not straight(model, filtered):
        grid = grid_of(model, smooths)
        is_open |= grid is not None and _is_little_work(grid, model)
    rows = np.flatnonzero(is_open)
    grid = grid_of(model, smooths) if rows.size else None
    if grid is None:
        return Tracks.empty(model, 0), np.arange(0)
    tracks = _tracked(replace(grid, gate=gate), model, z[rows])
    known = np.flatnonzero(np.isfinite(tracks.mean).all(axis=(1, 2)))
    return take(tracks, known), rows[known]


def grid_of(model: StateModel, smooths: bool = True) -> Grid | None:
    """Returns the grid that is exact for a model; None if none is."""
    grid = Grid(_POINTS, smooths).fitting(model)
    return grid if isinstance(grid, Grid) else None


def _is_little_work(grid: Grid, model: StateModel) -> bool:
    return grid.points == _POINTS or grid.points**2 * model.epochs <= _WORK


def _tracked(grid: Grid, model: StateModel, z: Array) -> Tracks:
    """Tracks trials by a grid; NaN of those that it has no answer for."""
    try:
        return grid.track(model, z)
    except ArithmeticError:
        if len(z) == 1:
            return Tracks.lost(model, 1)
    return Tracks.join([_tracked(grid, model, half) for half in np.array_split(z, 2)])


def folded(model: StateModel, filtered: Tracks) -> Mask:
    """Tells in which trials (trials,) some reading of a scalar state is folded."""
    x = _predicted(model, filtered)
    seen = np.isfinite(filtered.innovations)
    h, turns = _readings(model, x)
    rise = model.nearest(h[1:], h[:-1]) - h[:-1]
    deviation = _deviations(model, x)
    steepest = np.abs(rise).max(axis=0)
    # All rises are measured in the direction of the whole.
    least = (rise * np.sign(rise.sum(axis=0))).min(axis=0)
    bent = (steepest > _SEEN * deviation.min(axis=0)) & ~(least >= _EVEN * steepest)
    unlike = deviation.max(axis=0) > _NOISES * deviation.min(axis=0)
    return (seen & (bent | unlike | (turns > _ROUND))).any(axis=(1, 2))


def straight(model: StateModel, filtered: Tracks) -> bool:
    """Tells whether transitions and readings are straight lines among the states of a filter, with
    the same noise at all of them."""
    if model.gain_by_state or model.R_by_state:
        return False
    path, P = whole(filtered)
    spread = np.sqrt(P[..., 0])
    f, h = model.epoch_functions
    for function, x, far in ((f, path[:, :-1], spread[:, :-1]), (h, path[:, 1:], spread[:, 1:])):
        slopes = np.array([function.slopes(x + at * far)[1] for at in _AMONG])
        # Of a state that is not a number nothing is known.
        if not np.ptp(slopes, axis=0).max() <= _STRAIGHT * np.abs(slopes).max():
            return False
    return True


def calls(model: StateModel) -> float:
    """Counts the evaluations of f and of h that this takes of a trial."""
    slopes = 2 * (model.evaluations - model.epochs)
    of_reading = 2 if any(model.periods) else 1
    return float(slopes + of_reading * len(_AMONG) * model.epochs)


def _predicted(model: StateModel, filtered: Tracks) -> Array:
    """Returns states (points, trials, K, 1) among those that the filter predicts."""
    path, P = whole(filtered)
    moved, F = model.epoch_functions[0].slopes(path[:, :-1])
    Q = [_process(model, path[:, k], k) for k in range(model.epochs)]
    variance = F[..., 0] ** 2 * P[:, :-1, 0] + np.stack(Q, axis=1)
    return moved + _AMONG[:, None, None, None] * np.sqrt(variance)


def _readings(model: StateModel, x: Array) -> tuple[Array, Array]:
    """Returns readings (points, trials, K, m) of states x (points, trials, K, 1), and through how
    many of its periods each goes between the first and the last of these, where it rises as at the
    steepest of them."""
    h = model.epoch_functions[1]
    if not any(model.periods):
        values = np.stack([h.values(at) for at in x])
        return values, np.zeros(values.shape[1:])
    values, slopes = map(np.stack, zip(*(h.slopes(at) for at in x), strict=True))
    # Differences between points do not tell whole turns.
    turn = np.where(model.periods, model.periods, np.inf)
    way = np.abs(slopes[..., 0]).max(axis=0) * (x[-1] - x[0])
    return values, way / turn


def _process(model: StateModel, x: Array, k: int) -> Array:
    """Returns the variances (trials, 1) of the process noise into epoch k from states x (trials,
    1)."""
    if not model.moves(k):
        return np.zeros(x.shape)
    return np.broadcast_to(model.Q_at(x, k)[..., 0], x.shape)


def _deviations(model: StateModel, x: Array) -> Array:
    """Returns the standard deviations (points, trials, K, m) of readings at states x (points,
    trials, K, 1)."""
    shape = (*x.shape[:2], model.readings_per_epoch)
    R = [np.diagonal(model.R_at(x[:, :, k], k), axis1=-2, axis2=-1) for k in range(model.epochs)]
    return np.sqrt(np.stack([np.broadcast_to(each, shape) for each in R], axis=2))
