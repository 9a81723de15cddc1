"""Finds how wide the steps of differences may be where nobody says it."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.functions.differences import (
    TOLERANCE,
    Near,
    Rows,
    along_units,
    measured,
    not_small,
    quick,
    unmoved,
)

_NARROWER = 3.0**-9
"""Part of a rough widest step that is narrow."""
_ALIKE = 1e-3
"""Part of the largest slope of an output by which wide and narrow steps may disagree."""
_PARTS = 3.0 ** -np.arange(0.0, 16.0, 3.0)
"""Parts of rough widest steps that are tried."""
_MANY_LEVELS = 20
"""Steps of the ladder that is believed in their place."""
_BETTER = 0.01
"""Share of the outputs by which narrower steps must find more slopes."""


def widest_steps(h: Rows, x: Array, rough: Array, near: Near = unmoved) -> Array:
    """Finds the widest steps (n,) for differences at x (n,): parts of rough ones at which few
    differences find the slopes in nearly all outputs."""
    here = x[None]

    def quickly(part: float) -> Array:
        """Computes slopes (m, n) per rough step, by widest steps that are a part of them."""
        slope, _ = quick(h, here, part * rough, near)
        return slope[0] / part

    with np.errstate(all="ignore"):
        narrow = quickly(_NARROWER)
        largest = np.abs(narrow).max(axis=1, keepdims=True)
        # Wide steps may step over what only narrow ones find.
        if (np.abs(quickly(1.0) - narrow) <= _ALIKE * largest).all():
            return rough
        ladder = measured(h, here, along_units(rough, 1), near, _MANY_LEVELS).central
        slope = ladder.slope[0]
        size = np.abs(slope)
        size = not_small(size, size.max(axis=1, keepdims=True))
        allowed = np.maximum(3 * ladder.error[0], TOLERANCE * size)
        best = _PARTS[-1] * rough
        most = np.zeros(len(rough))
        for part in _PARTS:
            found = np.abs(quickly(part) - slope) <= allowed
            share = found.mean(axis=0)
            better = share > most + _BETTER
            best = np.where(better, part * rough, best)
            most = np.where(better, share, most)
    return best
