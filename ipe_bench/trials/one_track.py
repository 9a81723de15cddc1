"""Keeps the first tracks of each tracker as they are, with truth and readings, so that a report can
show one."""

from __future__ import annotations

import base64
from collections.abc import Sequence

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.trials.thresholds import HISTORIES

COLUMN = "curves_track"
"""The stored column of a track, or of a true path with its readings."""
_POSITION = ("x", "y")


def position_of(names: Sequence[str]) -> tuple[int, int] | None:
    """Returns which two states are a position in a plane."""
    if not set(_POSITION) <= set(names):
        return None
    first, second = map(list(names).index, _POSITION)
    return first, second


def first_tracks(start: int, mean: Array, P: Array, names: Sequence[str]) -> Array:
    """Returns the texts (trials,) of a block from trial `start` on: means (trials, K, n), their
    standard deviations, and the covariance of a position."""
    variances = np.diagonal(P, axis1=2, axis2=3)
    across = np.zeros(mean.shape[:2])
    place = position_of(names)
    if place is not None:
        across = P[:, :, place[0], place[1]]
    return texts(start, np.concatenate([mean, np.sqrt(variances), across[..., None]], axis=2))


def texts(start: int, values: Array) -> Array:
    """Returns values (trials, K, columns) as texts (trials,), those of the first trials alone."""
    written = []
    for trial, each in enumerate(values, start):
        kept = each.astype("<f4").tobytes() if trial < HISTORIES else b""
        written.append(base64.b64encode(kept).decode())
    return np.array(written, dtype=object)


def read_text(text: str, epochs: int) -> Array:
    """Returns the values (K, columns) of a text."""
    return np.frombuffer(base64.b64decode(text), "<f4").astype(float).reshape(epochs, -1)
