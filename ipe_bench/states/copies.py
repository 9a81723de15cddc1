"""Copies of a path that differ from it by whole periods of a state, such as turns of an angle read
by its sine."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.states.base import StateModel
from ipe_bench.states.smoothers import whole
from ipe_bench.states.trackers import Tracks
from ipe_bench.states.whole_paths import PathDensity

SURE = 0.95
"""A path is ambiguous where it is less probable than this among its copies."""
_REACH = 8.0
"""Deviations of the prior to either side of its mean within which copies begin."""
_MOST = 30
"""Periods to either side at most."""


def copy_p(model: StateModel, z: Array, tracks: Tracks) -> Array | None:
    """Computes the probability (trials,) that each path and none of its copies is the right one, by
    their costs J,

        p = exp(-J / 2) / sum of exp(-J_s / 2) over the path and its copies.

    A copy has one state shifted by whole periods from beginning to end. NaN for a path that is not
    finite; None if the model has no periods or noise by state, and for trackers without a path of a
    cost."""
    by_state = model.gain_by_state or model.R_by_state
    if tracks.cost is None or by_state or not any(model.state_periods):
        return None
    with np.errstate(all="ignore"):
        return _p(PathDensity.of(model, z), whole(tracks)[0])


def _p(density: PathDensity, x: Array) -> Array:
    """Computes the probability (trials,) of paths x (trials, 1 + K, n) among their copies."""
    model = density.model
    m, P = model.prior
    cost = density.settled(x).cost
    total = np.ones(len(x))
    for i, period in enumerate(model.state_periods):
        if not period:
            continue
        begun = np.round((x[:, 0, i] - m[i]) / period)
        reach = min(_MOST, int(np.ceil(_REACH * np.sqrt(P[i, i]) / period)))
        for turns in range(-reach, reach + 1):
            shift = turns - begun
            other = x.copy()
            other[:, :, i] += (period * shift)[:, None]
            ratio = np.exp((cost - density.settled(other).cost) / 2)
            total += np.where(shift == 0, 0.0, ratio)
    return np.where(np.isfinite(cost), 1.0 / total, np.nan)
