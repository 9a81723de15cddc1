"""Finds trials of a scalar state in which a filter by tangents misleads itself, and answers them by
the exact density on a grid.

Each reading is looked at from five states among those that the extended filter predicts. It is
*folded* if the filter's tangent says little of it there: it turns back, as a square does, or hardly
rises any more; it comes round through much of its period; or its noise is far from the same.
"""

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
fine one may take a second. Nearly all evaluations of `auto` are those of f and h at them; with 100
means are 4e-4 off where noise depends on the state."""
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
    the extended filter predicts, and which trials these are; none if no grid is exact. Readings
    beyond a quantile `gate` are missing. `of_all` asks for all trials of a model that is not
    straight and whose grid is no work."""
    none = Tracks.empty(model, 0), np.arange(0)
    if not may_fold(model):
        return none
    asked = folded(model, filtered)
    if Filter().hindrance(model):
        # The state changes their noise, not their mean: a filter takes nothing from them.
        asked[:] = True
    if of_all and not straight(model, filtered):
        grid = grid_of(model, smooths)
        asked |= grid is not None and _is_little_work(grid, model)
    rows = np.flatnonzero(asked)
    grid = grid_of(model, smooths) if rows.size else None
    if grid is None:
        return none
    tracks = _tracked(replace(grid, gate=gate), model, z[rows])
    answered = np.flatnonzero(np.isfinite(tracks.mean).all(axis=(1, 2)))
    return take(tracks, answered), rows[answered]


def _is_little_work(grid: Grid, model: StateModel) -> bool:
    return grid.points == _POINTS or grid.points**2 * model.epochs <= _WORK


def grid_of(model: StateModel, smooths: bool = True) -> Grid | None:
    """Returns the grid that is exact for a model; None if none is."""
    grid = Grid(_POINTS, smooths).fitting(model)
    return grid if isinstance(grid, Grid) else None


def _tracked(grid: Grid, model: StateModel, z: Array) -> Tracks:
    """Tracks trials by a grid; NaN of those that it has no answer for."""
    try:
        return grid.track(model, z)
    except ArithmeticError:
        if len(z) == 1:
            return Tracks.lost(model, 1)
    # The trial that has no answer is in one of the halves.
    halves = np.array_split(z, 2)
    return Tracks.join([_tracked(grid, model, half) for half in halves])


def folded(model: StateModel, filtered: Tracks) -> Mask:
    """Tells in which trials (trials,) some reading of a scalar state is folded."""
    x = _looked_from(model, filtered)
    deviation = _deviations(model, x)
    least = deviation.min(axis=0)
    unlike = deviation.max(axis=0) > _NOISES * least
    h, slopes = _readings(model, x)
    rise = model.nearest(h[1:], h[:-1]) - h[:-1]
    # A reading without a value at one of the states counts as even. Nothing is lost by that: a grid
    # reaches further, and has no answer for a model whose readings have no value at some points.
    misleading = _is_bent(rise, least) | unlike
    if slopes is not None:
        misleading |= _comes_round(model, slopes, x[-1] - x[0])
    there = np.isfinite(filtered.innovations)
    return (there & misleading).any(axis=(1, 2))


def straight(model: StateModel, filtered: Tracks) -> bool:
    """Tells whether transitions and readings are straight lines among the states of a filter, with
    the same noise at all of them."""
    if model.gain_by_state or model.R_by_state:
        return False
    path, P = whole(filtered)
    states = path + _scaled(np.sqrt(P[..., 0]))
    f, h = model.epoch_functions
    of_f = np.stack([f.slopes(x)[1] for x in states[:, :, :-1]])
    of_h = np.stack([h.slopes(x)[1] for x in states[:, :, 1:]])
    return _is_constant(of_f) and _is_constant(of_h)


def calls(model: StateModel) -> float:
    """Counts the evaluations of f and of h that this takes of a trial."""
    transitions = model.evaluations - model.epochs
    of_reading = 2 if any(model.periods) else 1
    return float(2 * transitions + of_reading * len(_AMONG) * model.epochs)


def _scaled(deviation: Array) -> Array:
    """Returns how far points (points, trials, K, 1) are from what is predicted, with these standard
    deviations (trials, K, 1)."""
    return _AMONG[:, None, None, None] * deviation


def _looked_from(model: StateModel, filtered: Tracks) -> Array:
    """Returns states (points, trials, K, 1) among those that the filter predicts."""
    path, P = whole(filtered)
    moved, F = model.epoch_functions[0].slopes(path[:, :-1])
    Q = np.stack([_process_noise(model, path[:, k], k) for k in range(model.epochs)], axis=1)
    variance = F[..., 0] ** 2 * P[:, :-1, 0] + Q
    return moved + _scaled(np.sqrt(variance))


def _process_noise(model: StateModel, x: Array, k: int) -> Array:
    """Returns the variances (trials, 1) of the process noise into epoch k from states x (trials,
    1)."""
    if not model.moves(k):
        return np.zeros(x.shape)
    return np.broadcast_to(model.Q_at(x, k)[..., 0], x.shape)


def _deviations(model: StateModel, x: Array) -> Array:
    """Returns the standard deviations (points, trials, K, m) of readings at states x (points,
    trials, K, 1)."""
    variances = np.empty((*x.shape[:3], model.readings_per_epoch))
    for k in range(model.epochs):
        R = model.R_at(x[:, :, k], k)
        variances[:, :, k] = np.diagonal(R, axis1=-2, axis2=-1)
    return np.sqrt(variances)


def _readings(model: StateModel, x: Array) -> tuple[Array, Array | None]:
    """Returns readings (points, trials, K, m) of states x (points, trials, K, 1), and their slopes
    if any of them comes round."""
    h = model.epoch_functions[1]
    if not any(model.periods):
        return np.stack([h.values(states) for states in x]), None
    values, slopes = zip(*(h.slopes(states) for states in x), strict=True)
    return np.stack(values), np.stack(slopes)[..., 0]


def _is_bent(rise: Array, deviation: Array) -> Mask:
    """Tells which readings (trials, K, m) rise unevenly between points, by a `rise` (points - 1,
    trials, K, m), and somewhere by more than their deviation (trials, K, m)."""
    steepest = np.abs(rise).max(axis=0)
    # All rises are measured in the direction of the whole.
    direction = np.sign(rise.sum(axis=0))
    flattest = (rise * direction).min(axis=0)
    tells = steepest > _SEEN * deviation
    return tells & ~(flattest >= _EVEN * steepest)


def _comes_round(model: StateModel, slopes: Array, way: Array) -> Mask:
    """Tells which readings (trials, K, m) go through much of their period along a way (trials, K,
    1) of the state, if they rise all along as at the steepest of the points, whose slopes (points,
    trials, K, m) these are: differences between points do not tell whole turns."""
    steepest = np.abs(slopes).max(axis=0)
    period = np.where(model.periods, model.periods, np.inf)
    return steepest * way > _ROUND * period


def _is_constant(slopes: Array) -> bool:
    """Tells whether slopes are the same at all points (points, ...)."""
    differences = np.ptp(slopes, axis=0).max()
    # Of a state that is not a number nothing is known.
    return bool(differences <= _STRAIGHT * np.abs(slopes).max())
