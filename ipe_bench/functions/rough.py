"""Slopes of functions that are rough, such as by the tolerance of an integrator inside them.

Of such a function narrow steps find the roughness, and wide ones the curvature. So one step is
chosen for each number, once, by what a whole ladder of steps finds at some points
(`steps_of_a_rough_function`); elsewhere, central differences of these steps are the slopes
(`by_steps`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.functions.differences import (
    LEVELS,
    RATIO,
    TELLING,
    TOLERANCE,
    Near,
    Rows,
    Sampled,
    along_units,
    measured,
    not_small,
    sampled,
    silent,
)

_CLOSELY = 1e-7
"""Part of the largest slope to which steps are as good as wider ones."""
_NEARLY_ALL = 0.9
"""Share of the slopes that a step must find which is used in place of the ladder."""
_USUALLY = 10.0
"""Multiple of what the sides of a step differ at points that are tried, up to which it is believed
elsewhere."""
_ROUGHLY = 1e-4
"""Part of a slope by which the sides of a step may differ from it."""
_OTHERS = (27.0, 1.0 / 9.0)
"""Multiples of such steps that are tried where their sides disagree."""


class Steps(NamedTuple):
    """Holds steps of central differences for a function that is rougher than round-off."""

    widths: Array
    """(n,)"""
    apart: Array
    """By how much the slopes (m, n) of either side may differ from the central ones."""


def steps_of_a_rough_function(h: Rows, x: Array, scale: Array, near: Near) -> Steps | None:
    """Finds the steps by which central differences find at the first and most others of the points
    x (rows, n) what the whole ladder finds, to its error; None if there are none."""
    units = along_units(scale, len(x))
    parts = RATIO ** -np.arange(LEVELS)
    found = measured(h, x, units, near).central
    with silent():
        slope, apart = _sided(sampled(h, x, units, near, parts))
        size = np.abs(found.slope)
        largest = size.max(axis=2, keepdims=True)
        away = np.abs(slope - found.slope)
        levels, usual = _best_levels(away / size.max(axis=1, keepdims=True))
        numbers = np.arange(len(scale))

        def at_their_levels(values: Array) -> Array:
            """Selects of values (levels, rows, m, n) those of each number's level."""
            return values[levels, :, :, numbers].transpose(1, 2, 0)

        allowed = 3 * found.error + TOLERANCE * not_small(size, largest)
        right = at_their_levels(away) <= allowed
        # A ladder that does not settle, as on a function that jumps everywhere, tells of no step.
        right &= found.error <= TELLING * largest
        right |= ~np.isfinite(found.slope)
        nearly = (right.mean(axis=1) >= _NEARLY_ALL).all(axis=1)
        known = np.isfinite(usual).all()
        most = 2 * nearly.sum() > len(x)
        if not (known and nearly[0] and most):
            return None
        apart = at_their_levels(apart)
        apart = np.median(np.where(np.isfinite(apart), apart, 0.0), axis=0)
        return Steps(scale * parts[levels], _USUALLY * apart / scale)


def _best_levels(away: Array) -> tuple[Array, Array]:
    """Chooses for each number the narrowest level whose slopes are good, or else the best, by how
    far slopes (levels, rows, m, n) are off; returns the levels (n,) and how far they usually
    are."""
    worst = away.max(axis=2)
    usual = np.median(np.where(np.isfinite(worst), worst, np.inf), axis=1)
    good = usual <= _CLOSELY
    # The narrowest of good steps meets the fewest jumps and kinks.
    narrowest = len(good) - 1 - np.argmax(good[::-1], axis=0)
    levels = np.where(good.any(axis=0), narrowest, np.argmin(usual, axis=0))
    return levels, usual[levels, np.arange(len(levels))]


def by_steps(h: Rows, x: Array, steps: Steps, near: Near) -> Array:
    """Computes dh/dx (rows, m, n) at x (rows, n) by a central difference of those steps; where its
    sides disagree, by a wider or narrower one if its sides agree better."""
    slope, apart = _by_widths(h, x, steps.widths, near)
    with np.errstate(all="ignore"):
        size = np.abs(slope)
        size = not_small(size, size.max(axis=2, keepdims=True))
        allowed = np.maximum(steps.apart, _ROUGHLY * size)
        rows = np.flatnonzero((~(apart <= allowed)).any(axis=(1, 2)))
    if not rows.size:
        return slope
    for part in _OTHERS:
        other, by = _by_widths(h, x[rows], part * steps.widths, near)
        better = ~(apart[rows] <= by) & np.isfinite(by)
        slope[rows] = np.where(better, other, slope[rows])
        apart[rows] = np.where(better, by, apart[rows])
    return slope


def _by_widths(h: Rows, x: Array, widths: Array, near: Near) -> tuple[Array, Array]:
    """Returns slopes (rows, m, n) by steps, and by how much those of each side differ from them."""
    with silent():
        found = sampled(h, x, along_units(widths, len(x)), near, np.ones(1))
        slope, apart = _sided(found)
        return slope[0] / widths, apart[0] / widths


def _sided(found: Sampled) -> tuple[Array, Array]:
    """Returns central differences (levels, rows, m, p) by the steps of each level, and by how much
    those of each side differ from them: more than by the bend at a jump or a kink."""
    sides = np.abs(found.forward - found.backward) / 2
    return found.central.swapaxes(2, 3), sides.swapaxes(2, 3)
