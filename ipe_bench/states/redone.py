"""Tracks again, by the model's own functions, the trials at whose states recorded ones are not
these."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.states.base import StateModel

_INSIDE: ContextVar[bool] = ContextVar("inside another tracker", default=False)
_UNCHANGED: ContextVar[bool] = ContextVar("nothing changes the model", default=False)


@contextmanager
def unchanged() -> Iterator[None]:
    """States that no model changes within, so that it need not be looked at before each track."""
    outside = _UNCHANGED.set(True)
    try:
        yield
    finally:
        _UNCHANGED.reset(outside)


def believed(track: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a tracker's method `track` forget recordings that are not of the model any more, and
    track those trials again that recorded functions led astray."""

    @functools.wraps(track)
    def run(tracker: Any, model: StateModel, z: Array) -> Any:
        if _INSIDE.get() or not isinstance(model, StateModel):
            return track(tracker, model, z)
        outside = _INSIDE.set(True)
        try:
            if not _UNCHANGED.get():
                model.renew()
            tracks = track(tracker, model, z)
            astray = _astray(model, tracks)
            rows = np.flatnonzero(astray)
            if rows.size:
                again = track(tracker, model.by_epoch(), z[rows])
                for one in fields(tracks):
                    _take(getattr(tracks, one.name), getattr(again, one.name), rows)
                tracks.by_epoch = astray
            return tracks
        finally:
            _INSIDE.reset(outside)

    return run


def _astray(model: StateModel, tracks: Any) -> Mask:
    mean = np.asarray(tracks.mean, dtype=float)
    start = np.broadcast_to(model.prior.mean, (len(mean), 1, model.n))
    return model.astray(np.concatenate([start, mean], axis=1))


def _take(mine: Any, its: Any, rows: Array) -> None:
    """Puts what was found again of some trials in the place of what was found of them first."""
    if isinstance(mine, np.ndarray) and isinstance(its, np.ndarray):
        mine[rows] = its
    elif isinstance(mine, list | tuple):
        for part, new in zip(mine, its, strict=True):
            _take(part, new, rows)
