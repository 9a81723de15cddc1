"""Tells where a filter by tangents misleads itself: among the states that it predicts a reading
turns back, hardly rises any more, or has other noise."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.states.base import StateModel
from ipe_bench.states.smoothers import whole
from ipe_bench.states.trackers import Tracks

_AMONG = np.linspace(-2.0, 2.0, 5)
"""Where readings are looked at, in standard deviations of what is predicted."""
_EVEN = 0.2
"""Part of its steepest rise between these points that a reading has between all of them, unless it
is folded."""
_SEEN = 1.0
"""Standard deviations of a reading that its steepest rise is at least, if it tells of the state."""
_NOISES = 3.0
"""How many times the least standard deviation of a reading at these points the largest may be."""


def folded(model: StateModel, filtered: Tracks) -> Mask:
    """Tells in which trials (trials,) some reading of a scalar state is folded."""
    x = _predicted(model, filtered)
    seen = np.isfinite(filtered.innovations)
    h = np.stack([model.epoch_functions[1].values(at) for at in x])
    rise = model.nearest(h[1:], h[:-1]) - h[:-1]
    deviation = _deviations(model, x)
    steepest = np.abs(rise).max(axis=0)
    # All rises are measured in the direction of the whole.
    least = (rise * np.sign(rise.sum(axis=0))).min(axis=0)
    bent = (steepest > _SEEN * deviation.min(axis=0)) & ~(least >= _EVEN * steepest)
    unlike = deviation.max(axis=0) > _NOISES * deviation.min(axis=0)
    return (seen & (bent | unlike)).any(axis=(1, 2))


def calls(model: StateModel) -> float:
    """Counts the evaluations of f and of h that this takes of a trial."""
    slopes = 2 * (model.evaluations - model.epochs)
    return float(slopes + len(_AMONG) * model.epochs)


def _predicted(model: StateModel, filtered: Tracks) -> Array:
    """Returns states (points, trials, K, 1) among those that the filter predicts."""
    path, P = whole(filtered)
    moved, F = model.epoch_functions[0].slopes(path[:, :-1])
    Q = [_process(model, path[:, k], k) for k in range(model.epochs)]
    variance = F[..., 0] ** 2 * P[:, :-1, 0] + np.stack(Q, axis=1)
    return moved + _AMONG[:, None, None, None] * np.sqrt(variance)


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
