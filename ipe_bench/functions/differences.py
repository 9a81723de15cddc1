"""Slopes by differences that know their error, and what they say of other slopes.

Steps shrink by a ratio of 3 from the widest; central differences and those of either side are
extrapolated three times. A function takes rows (rows, n) and returns rows (rows, m), and each row
is differentiated by itself.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask

Rows = Callable[[Array], Array]
Near = Callable[[Array, Array], Array]
"""Puts values next to others by whole periods."""

LEVELS = 9
"""Steps of a ladder."""
_EPS = np.finfo(float).eps
_RATIO = 3.0
_COLUMNS = 3
"""Extrapolations of the differences of each step."""
_QUICK = (3, 4, 8)
"""Steps of the ladder whose differences are believed if they agree."""
_BESIDE = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
"""Places of neighbours of a point, by which its noise is known, in parts of the finest step."""
_TOLERANCE = 1e-6
"""Part of a slope by which a right one may differ, beside the error of the differences."""
_SMALL = 1e-3
"""Part of the largest slope of an output below which no slope counts as smaller."""
_QUICKLY = 1e-7
"""Part of a slope by which three steps may disagree."""
_TELLING = 1e-2
"""Part of a slope up to which the error of differences lets them say that it is right."""
_ROUGHLY = 1e-4
"""Part of a slope by which the sides of a step of a rough function may differ from it."""
_OTHERS = (27.0, 1.0 / 9.0)
"""Multiples of such steps that are tried where their sides disagree."""
_CLOSELY = 1e-7
"""Part of the largest slope to which steps are as good as wider ones."""
_USUALLY = 10.0
"""Multiple of what the sides of a step differ at points that are tried, up to which it is believed
elsewhere."""
_NEARLY_ALL = 0.9
"""Share of the slopes that a step must find which is used in place of the ladder."""
RIGHT, UNKNOWN, WRONG = 0, 1, 2


def unmoved(values: Array, to: Array) -> Array:
    """Leaves values where they are: a `Near` of what has no period."""
    return values


class Limit(NamedTuple):
    """Holds slopes with the errors that they may have; infinite if steps do not settle."""

    slope: Array
    error: Array


class Measured(NamedTuple):
    """Holds slopes (rows, m, p) along p directions: central ones, and those of either side."""

    central: Limit
    ahead: Limit
    behind: Limit


class Moved(NamedTuple):
    """Holds what a function does along directions, by steps of some levels of the ladder."""

    here: Array
    """The values (rows, 1, m)."""
    up: Array
    """The values ahead (levels, rows, p, m)."""
    down: Array
    """The values behind, likewise."""
    ahead: Array
    """The steps ahead as they are in floating point (levels, rows, p, 1), in parts of the
    direction."""
    behind: Array
    """Likewise."""
    beside: Array
    """The values of neighbours (6, rows, p, m)."""


def measured(
    h: Rows, x: Array, directions: Array, near: Near = unmoved, levels: int = LEVELS
) -> Measured:
    """Differentiates h at x (rows, n) along directions (rows, p, n), which are the widest steps, in
    one call of h."""
    parts = _RATIO ** -np.arange(levels)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        moved = _moved(h, x, directions, near, parts, _BESIDE * parts[-1] / 3)
        here, up, down, ahead, behind, _ = moved
        size = np.maximum(np.abs(here), np.maximum(np.abs(up), np.abs(down)))
        coarse = 2 * _resolution(moved) * size
        noise = np.fmax(coarse, 3 * _scatter(here, moved.beside)) / ahead
        # A step that is a few units of round-off of what it moves is no step along the direction.
        moving = np.where(directions != 0, np.abs(x)[:, None], 0.0).max(axis=2)
        widest = np.abs(directions).max(axis=2)
        blur = (_EPS * moving / widest)[:, :, None] / ahead
        sides = (
            ((up - down) / (ahead + behind), 2),
            ((up - here) / ahead, 1),
            ((here - down) / behind, 1),
        )
        limits = [_limit(C, noise + np.abs(C) * blur, order) for C, order in sides]
        limits[0] = _settled(*limits)
    return Measured(*(Limit(one.slope.swapaxes(1, 2), one.error.swapaxes(1, 2)) for one in limits))


def _moved(h: Rows, x: Array, directions: Array, near: Near, parts: Array, beside: Array) -> Moved:
    """Computes h at x, at parts of the directions ahead and behind, and at other parts beside."""
    rows, p, n = directions.shape
    steps = parts[:, None, None, None] * directions
    above = x[:, None] + steps
    below = x[:, None] - steps
    neighbours = x[:, None] + beside[:, None, None, None] * directions
    each = (x, neighbours, above, below)
    points = np.concatenate([one.reshape(-1, n) for one in each])
    values = np.asarray(h(points), dtype=float)
    ends = np.cumsum([one.size // n for one in each])[:-1]
    here, near_by, up, down = np.split(values, ends)
    here = here[:, None]

    def placed(given: Array, count: int) -> Array:
        shaped = given.reshape(count, rows, p, values.shape[1])
        return near(shaped, np.broadcast_to(here, shaped.shape))

    length = np.abs(directions).sum(axis=2)
    ahead = np.abs(above - x[:, None]).sum(axis=3) / length
    behind = np.abs(below - x[:, None]).sum(axis=3) / length
    return Moved(
        here,
        placed(up, len(parts)),
        placed(down, len(parts)),
        ahead[..., None],
        behind[..., None],
        placed(near_by, len(beside)),
    )


def _resolution(moved: Moved) -> Array:
    """Returns the relative distance (rows, p, m) of neighbouring values: that of single precision
    where all that move have no more digits."""
    here, up, down = moved.here, moved.up, moved.down
    short = single(here) & single(up).all(axis=0) & single(down).all(axis=0)
    moves = (up != here).any(axis=0) | (down != here).any(axis=0)
    return np.where(short & moves, np.finfo(np.float32).eps, _EPS)


def single(values: Array) -> Mask:
    """Tells of each value whether it has no more digits than single precision holds."""
    with np.errstate(all="ignore"):
        return values == values.astype(np.float32)


def _scatter(here: Array, beside: Array) -> Array:
    """Estimates the noise (rows, p, m) of values, by high differences of neighbours, which smooth
    functions lack (More and Wild, SIAM J. Sci. Comput. 33, 2011)."""
    line = np.concatenate([beside[:3], np.broadcast_to(here, beside[:1].shape), beside[3:]])
    fourth = np.diff(line, 4, axis=0) / math.sqrt(70)
    fifth = np.diff(line, 5, axis=0) / math.sqrt(252)
    return np.sqrt(np.maximum((fourth**2).mean(axis=0), (fifth**2).mean(axis=0)))


def _settled(central: Limit, ahead: Limit, behind: Limit) -> Limit:
    """Believes the sides where they agree and central differences do not agree with them: the error
    of these is not even in the step where the curvature jumps."""
    mean = (ahead.slope + behind.slope) / 2
    error = np.maximum(ahead.error, behind.error)
    smooth = np.abs(ahead.slope - behind.slope) <= 3 * (ahead.error + behind.error)
    sides = smooth & (error < np.abs(central.slope - mean))
    return Limit(np.where(sides, mean, central.slope), np.where(sides, error, central.error))


def _limit(C: Array, noise: Array, order: int) -> Limit:
    """Extrapolates differences C (levels, ...) of shrinking steps, each with its noise, whose error
    is of that order and its multiples."""
    moved = np.abs(np.diff(C, axis=0))
    # What moves beyond noise from each step to finer ones, at the most.
    beyond = moved - 3 * (noise[:-1] + noise[1:])
    later = np.fmax.accumulate(beyond[::-1], axis=0)[::-1]
    best = C[-1]
    least = np.full(C.shape[1:], np.inf)
    column = C
    noisy = noise
    error = np.concatenate([np.full((1, *C.shape[1:]), np.inf), moved])
    for k in range(_COLUMNS + 1):
        if k:
            gain = _RATIO ** (order * k)
            finer = column[1:] + (column[1:] - column[:-1]) / (gain - 1.0)
            apart = np.abs(finer - column[:-1]) / gain
            error = np.maximum(np.abs(finer - column[1:]), apart)
            noisy = noisy[1:] * (1 + 2 / (gain - 1.0))
            column = finer
        for i in range(len(column)):
            level = len(C) - len(column) + i
            here = error[i] + noisy[i]
            # Wide steps say nothing of a function that moves more at finer ones, or elsewhere.
            if 0 < level < len(moved):
                used = moved[max(0, level - k - 1) : level].max(axis=0)
                here = np.where(later[level] > used, np.maximum(here, later[level]), here)
            if level + 1 < len(moved):
                away = np.abs(column[i] - C[level + 1 : -1])
                allowed = 2 * moved[level + 1 :] + 3 * noise[level + 1 : -1]
                here = np.maximum(here, np.fmax.reduce(away - allowed, axis=0))
            better = here < least
            best = np.where(better, column[i], best)
            least = np.where(better, here, least)
    return Limit(best, least)


def judge(J: Array, found: Measured) -> NDArray[np.int8]:
    """Says of each slope in J (rows, m, p), along the same directions, whether it is RIGHT, WRONG
    or UNKNOWN."""
    central, ahead, behind = found
    with np.errstate(all="ignore"):
        size = np.maximum(np.abs(J), np.abs(central.slope))
        largest = np.where(np.isfinite(size), size, 0.0).max(axis=2, keepdims=True)
        size = np.maximum(size, _SMALL * largest)
        allowed = _TOLERANCE * size
        sides = ahead.error + behind.error
        reach = 3 * sides + allowed
        kink = np.abs(ahead.slope - behind.slope) > reach
        # At a kink any slope between those of the sides is right.
        low = np.minimum(ahead.slope, behind.slope) - reach
        high = np.maximum(ahead.slope, behind.slope) + reach
        close = np.abs(J - central.slope) <= 3 * central.error + allowed
        right = np.isfinite(J) & np.where(kink, (low <= J) & (high >= J), close)
        telling = kink | (central.error <= _TELLING * size + 1e-300)
        known = np.isfinite(central.error)
    verdict = np.where(right & telling, RIGHT, UNKNOWN)
    return np.where(known & ~right, WRONG, verdict).astype(np.int8)


def along_units(scale: Array, rows: int) -> Array:
    """Returns the directions (rows, n, n) of each number, with its widest step."""
    return np.broadcast_to(np.diag(scale), (rows, len(scale), len(scale)))


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
    parts = _RATIO ** -np.arange(LEVELS)
    found = measured(h, x, units, near).central
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        slope, apart = _sided(_moved(h, x, units, near, parts, np.empty(0)))
        size = np.abs(found.slope)
        largest = size.max(axis=2, keepdims=True)
        allowed = 3 * found.error + _TOLERANCE * np.maximum(size, _SMALL * largest)
        away = np.abs(slope - found.slope)
        # Per point and level, beside the largest slope of all outputs.
        worst = (away / size.max(axis=1, keepdims=True)).max(axis=2)
        usual = np.median(np.where(np.isfinite(worst), worst, np.inf), axis=1)
        # The narrowest of good steps meets the fewest jumps and kinks.
        narrowest = len(usual) - 1 - np.argmax(usual[::-1] <= _CLOSELY, axis=0)
        good = (usual <= _CLOSELY).any(axis=0)
        best = np.where(good, narrowest, np.argmin(usual, axis=0))
        each = np.arange(len(scale))
        # A ladder that does not settle, as on a function that jumps everywhere, tells of no step.
        telling = found.error <= _TELLING * largest
        right = (away[best, :, :, each] <= allowed.transpose(2, 0, 1)) & telling.transpose(2, 0, 1)
        right |= ~np.isfinite(found.slope).transpose(2, 0, 1)
        known = np.isfinite(usual[best, each]).all()
        nearly = (right.mean(axis=2) >= _NEARLY_ALL).all(axis=0)
        if not known or not nearly[0] or 2 * nearly.sum() <= len(x):
            return None
        apart = apart[best, :, :, each]
        apart = np.median(np.where(np.isfinite(apart), apart, 0.0), axis=1).T
        widths = scale * parts[best]
        return Steps(widths, _USUALLY * apart / scale)


def by_steps(h: Rows, x: Array, steps: Steps, near: Near) -> Array:
    """Computes dh/dx (rows, m, n) at x (rows, n) by a central difference of those steps; where its
    sides disagree, by a wider or narrower one if its sides agree better."""
    slope, apart = _by_widths(h, x, steps.widths, near)
    with np.errstate(all="ignore"):
        size = np.abs(slope)
        size = np.maximum(size, _SMALL * size.max(axis=2, keepdims=True))
        allowed = np.maximum(steps.apart, _ROUGHLY * size)
        rows = np.flatnonzero((~(apart <= allowed)).any(axis=(1, 2)))
    for part in _OTHERS if rows.size else ():
        other, by = _by_widths(h, x[rows], part * steps.widths, near)
        better = ~(apart[rows] <= by) & np.isfinite(by)
        slope[rows] = np.where(better, other, slope[rows])
        apart[rows] = np.where(better, by, apart[rows])
    return slope


def _by_widths(h: Rows, x: Array, widths: Array, near: Near) -> tuple[Array, Array]:
    """Returns slopes (rows, m, n) by steps, and by how much those of each side differ from them."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        units = along_units(widths, len(x))
        slope, apart = _sided(_moved(h, x, units, near, np.ones(1), np.empty(0)))
        return slope[0] / widths, apart[0] / widths


def _sided(moved: Moved) -> tuple[Array, Array]:
    """Returns central differences (levels, rows, m, p) by the steps of each level, and by how much
    those of each side differ from them: more than by the bend at a jump or a kink."""
    ahead = (moved.up - moved.here) / moved.ahead
    behind = (moved.here - moved.down) / moved.behind
    return _central(moved), np.abs(ahead - behind).swapaxes(2, 3) / 2


def _central(moved: Moved) -> Array:
    """Returns central differences (levels, rows, m, p) by the steps of each level."""
    return ((moved.up - moved.down) / (moved.ahead + moved.behind)).swapaxes(2, 3)


def by_differences(
    h: Rows, x: Array, scale: Array, near: Near = unmoved, within: float = _QUICKLY
) -> Array:
    """Computes dh/dx (rows, m, n) at x (rows, n) by differences whose widest steps are `scale`
    (n,): by three steps where these agree `within` a part, else by the whole ladder, and there by a
    finer one too where the first leaves an error."""
    slope, apart = quick(h, x, scale, near)
    rows = np.flatnonzero(~(apart <= within).all(axis=1))
    if rows.size:
        slope[rows] = _by_ladders(h, x[rows], scale, near)
    return slope / scale


def quick(h: Rows, x: Array, scale: Array, near: Near = unmoved) -> tuple[Array, Array]:
    """Returns slopes (rows, m, n) per widest step by three steps of the ladder, and by which part
    of an output's slopes these disagree at the most (rows, n)."""
    parts = _RATIO ** -np.array(_QUICK, dtype=float)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        moved = _moved(h, x, along_units(scale, len(x)), near, parts, np.empty(0))
        here, up, down, ahead, _, _ = moved
        C = _central(moved)
        slope = C[1] + (C[1] - C[0]) / (_RATIO**2 - 1.0)
        size = np.maximum(np.abs(here), np.maximum(np.abs(up), np.abs(down))).max(axis=0)
        noise = (4 * _resolution(moved) * size / ahead[-1]).swapaxes(1, 2)
        # The finest step finds what the wide ones step over.
        apart = np.abs(slope - C[2]) - noise
        # What is extrapolated is no better than a part of its last correction.
        apart = np.maximum(apart, _QUICKLY * np.abs(slope - C[1]) / _SMALL)
        largest = np.abs(slope).max(axis=2, keepdims=True)
        apart = apart / np.maximum(np.abs(slope), _SMALL * largest)
        still = (C == 0.0).all(axis=0)
        return slope, np.where(still, 0.0, apart).max(axis=1)


def _by_ladders(h: Rows, x: Array, scale: Array, near: Near) -> Array:
    directions = along_units(scale, len(x))
    first = measured(h, x, directions, near).central
    slope = first.slope.copy()
    with np.errstate(all="ignore"):
        size = np.abs(slope)
        largest = np.fmax.reduce(size, axis=2, keepdims=True)
        settled = first.error <= _TOLERANCE * np.maximum(size, _SMALL * largest)
        rows = np.flatnonzero(~settled.all(axis=(1, 2)))
        if rows.size:
            part = _RATIO ** (LEVELS - 2)
            second = measured(h, x[rows], directions[rows] / part, near).central
            finer = part * second.slope
            error = part * second.error
            # A second round must agree with the first within its error.
            agrees = ~(np.abs(finer - slope[rows]) > 3 * first.error[rows])
            slope[rows] = np.where(agrees & (error < first.error[rows]), finer, slope[rows])
    return slope
