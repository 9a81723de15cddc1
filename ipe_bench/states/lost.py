"""Says where a track was lost: which entry of which function is not finite, at which epoch and
states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.states.along import Recording, lost
from ipe_bench.states.base import StateModel

_STEEPEST = 1e12
"""Slope from which on a complex step finds what has none."""
_NAMED = 4
"""States that are told with their values at most."""


def why_lost(model: StateModel, mean: Array, states: bool = True) -> Mapping[int, str]:
    """Says of each track (trials, K, n) that is not finite where it was lost, with the states or
    without; nothing of those whose functions are finite there with their slopes."""
    start = np.broadcast_to(model.prior.mean, (len(mean), 1, model.n))
    why = {}
    with np.errstate(all="ignore"):
        for k, rows in lost(np.concatenate([start, mean], axis=1)):
            for row in rows.tolist():
                before = start[row, 0] if k == 0 else mean[row, k - 1]
                found = _what(model, before, k, states)
                if found:
                    why[row] = f"at epoch {k + 1}, {found}"
    return why


def _what(model: StateModel, x: Array, k: int, states: bool) -> str:
    """Says what is not finite of the step from the states x (n,) into epoch k, or of its
    readings."""
    moved = model.transition_into(k)
    found = _entry(moved, x, model.transition_names)
    if found:
        return found + _at(model, x, states)
    there = moved(x[None])[0]
    found = _entry(model.observation_at(k), there, model.observe_names)
    return found + _at(model, there, states) if found else ""


def _entry(function: Recording, x: Array, names: tuple[str, ...]) -> str:
    value, slopes = function.slope(x[None])
    for i, name in enumerate(names):
        if not np.isfinite(value[0, i]):
            return f"{name} is {value[0, i]:g}"
        if not (np.abs(slopes[0, i]) < _STEEPEST).all():
            return f"{name} has no finite slope"
    return ""


def _at(model: StateModel, x: Array, states: bool) -> str:
    where = " at the mean of the prior" if np.array_equal(x, model.prior.mean) else ""
    if not states:
        return where
    each = [f"{state.name}={v:.4g}" for state, v in zip(model.states, x, strict=True)]
    more = ", ..." if len(each) > _NAMED else ""
    return f"{where or ' at'} {', '.join(each[:_NAMED])}{more}"
