"""Leaves readings out of a path that are too far from what all others say of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ipe_bench.basics.batches import gather, take
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.states.base import StateModel
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.smoothers import whole
from ipe_bench.states.trackers import Tracks, filtered, most_within

MOST_LEFT_OUT = 0.2
"""Share of readings beyond a gate above which a model is wrong, or a filter lost."""
_ROUNDS = 30
"""Paths at most, after the first."""
_BOTH_WAYS = 8
"""Of these, those after which a reading that was left out may come back: sets may take turns."""


class Expected(NamedTuple):
    """Holds what is expected of readings at the states of a track."""

    h: Array
    """(trials, K, m)"""
    of_states: Array
    """The variances (trials, K, m) of h by the covariances of the states."""
    noise: Array
    """The variances of the readings themselves: (K, m), or (trials, K, m)."""

    @classmethod
    def at(cls, model: StateModel, tracks: Tracks) -> Expected:
        with np.errstate(all="ignore"):
            along = model.slopes_along(whole(tracks).mean)
            H = along.H
            of_states = np.einsum("tkij,tkjl,tkil->tki", H, tracks.covariance, H)
            epochs = range(model.epochs)
            if model.R_by_state:
                R = np.stack([model.R_at(tracks.mean[:, k], k) for k in epochs], axis=1)
            else:
                R = model.covariances(np.array(epochs))
        return cls(along.h, of_states, np.diagonal(R, axis1=-2, axis2=-1))


def leaving_out(
    track: Callable[[Array], Tracks], model: StateModel, z: Array, gate: float
) -> Tracks:
    """Tracks paths by readings z (trials, K, m) without those beyond a quantile `gate`.

    First these are what the extended filter leaves out, or none if it is lost. Then, until nothing
    changes, they are those whose distance from the path of all other readings exceeds its standard
    deviation by too much: with a residual r, its variance R and that of h at the smoothed state, s,
    r^2 / (R - s) of a reading that the path knows, and r^2 / (R + s) of another one (deletion
    residuals: de Jong and Penzer, JASA 93, 1998).
    """
    out = filtered(model, z, Taylor(), gate=gate).gated
    assert out is not None
    share = out.sum(axis=(1, 2)) / np.isfinite(z).sum(axis=(1, 2))
    out[share > MOST_LEFT_OUT] = False
    tracks = track(np.where(out, np.nan, z))
    going = np.arange(len(z))
    for number in range(_ROUNDS):
        now = out[going]
        beyond = _beyond(model, z[going], take(tracks, going), now, most_within(gate))
        if number >= _BOTH_WAYS:
            beyond |= now
        changed = (beyond != now).any(axis=(1, 2))
        tracks.calls[going] += Taylor().calls(model.n) * model.evaluations
        going = going[changed]
        if not going.size:
            break
        out[going] = beyond[changed]
        again = track(np.where(out[going], np.nan, z[going]))
        again.calls += tracks.calls[going]
        rest = np.setdiff1d(np.arange(len(z)), going)
        tracks = gather([(rest, take(tracks, rest)), (going, again)])
    tracks.gated = out
    return tracks


def _beyond(model: StateModel, z: Array, tracks: Tracks, out: Mask, most: float) -> Mask:
    """Tells which readings (trials, K, m) are too far from what the others say, of which those
    `out` are no part of the tracks; without a number nothing changes."""
    h, of_states, noise = Expected.at(model, tracks)
    square = (z - model.nearest(h, np.where(np.isfinite(z), z, h))) ** 2
    variance = np.where(out, noise + of_states, noise - of_states)
    # A reading that determines the path by itself is not judged by it.
    beyond = (square > most * variance) & (variance > 0)
    return np.where(np.isfinite(square) & np.isfinite(variance), beyond, out)
