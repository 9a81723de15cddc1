"""Slopes by differences that know their error, and what they say of other slopes.

A function takes rows (rows, n) and returns rows (rows, m), and each row is differentiated by
itself. Along a direction, a caller's *widest step*, there is a *ladder* of steps, each a third of
the one before. Every step gives three differences: central ones, and those of either side, ahead
and behind. Each of the three is extrapolated to a step of 0, up to three times. The extrapolated
value of the least error is the slope; the error is what is left after the noise of the function's
values, after what finer steps move, and after the sides, where these disagree with the central
ones.

Slopes are per widest step, unless a function says otherwise: by how much outputs would change if
they went on as straight lines to the end of that step.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask

Rows = Callable[[Array], Array]
Near = Callable[[Array, Array], Array]
"""Puts values next to others by whole periods."""

LEVELS = 9
"""Steps of a ladder."""
RATIO = 3.0
"""How many times a step of the ladder is as wide as the next."""
TOLERANCE = 1e-6
"""Part of a slope by which a right one may differ, beside the error of the differences."""
TELLING = 1e-2
"""Part of a slope up to which the error of differences lets them say that it is right."""
SMALL = 1e-3
"""Part of the largest slope of an output below which no slope counts as smaller."""
# What differences say of a slope.
RIGHT = 0
UNKNOWN = 1
WRONG = 2
_EPS = np.finfo(float).eps
_COLUMNS = 3
"""Extrapolations of the differences of each step."""
_QUICK = (3, 4, 8)
"""Steps of the ladder whose differences are believed if they agree."""
QUICKLY = 1e-7
"""Part of a slope by which three steps may disagree."""
_BESIDE = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
"""Places of neighbours of a point, by which its noise is known, in thirds of the finest step."""
_NOWHERE = np.empty(0)


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


def measured(
    h: Rows, x: Array, directions: Array, near: Near = unmoved, levels: int = LEVELS
) -> Measured:
    """Differentiates h at x (rows, n) along directions (rows, p, n), which are the widest steps, in
    one call of h."""
    parts = RATIO ** -np.arange(levels)
    with silent():
        found = sampled(h, x, directions, near, parts, _BESIDE * parts[-1] / 3)
        noise = _noise(found)
        blur = _blur(x, directions) / found.ahead
        limits = []
        # The error of a central difference is even in the step, that of a side is not.
        for C, order in ((found.central, 2), (found.forward, 1), (found.backward, 1)):
            limits.append(_limit(C, noise + np.abs(C) * blur, order))
        central, ahead, behind = limits
        central = _settled(central, ahead, behind)
    return Measured(*map(_by_output, (central, ahead, behind)))


def judge(J: Array, found: Measured) -> NDArray[np.int8]:
    """Says of each slope in J (rows, m, p), along the same directions, whether it is RIGHT, WRONG
    or UNKNOWN."""
    central, ahead, behind = found
    with np.errstate(all="ignore"):
        size = np.maximum(np.abs(J), np.abs(central.slope))
        largest = np.where(np.isfinite(size), size, 0.0).max(axis=2, keepdims=True)
        size = not_small(size, largest)
        tolerance = TOLERANCE * size
        reach = 3 * (ahead.error + behind.error) + tolerance
        kink = np.abs(ahead.slope - behind.slope) > reach
        # At a kink any slope between those of the sides is right.
        low = np.minimum(ahead.slope, behind.slope) - reach
        high = np.maximum(ahead.slope, behind.slope) + reach
        between = (low <= J) & (high >= J)
        close = np.abs(J - central.slope) <= 3 * central.error + tolerance
        right = np.isfinite(J) & np.where(kink, between, close)
        telling = kink | (central.error <= TELLING * size + 1e-300)
        known = np.isfinite(central.error)
    verdict = np.where(right & telling, RIGHT, UNKNOWN)
    return np.where(known & ~right, WRONG, verdict).astype(np.int8)


def by_differences(
    h: Rows, x: Array, scale: Array, near: Near = unmoved, within: float = QUICKLY
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
    """Returns slopes (rows, m, n) per widest step, above 0, by three steps of the ladder, and by
    which part of an output's slopes these disagree at the most (rows, n)."""
    parts = RATIO ** -np.array(_QUICK, dtype=float)
    with silent():
        found = sampled(h, x, along_units(scale, len(x)), near, parts)
        C = found.central.swapaxes(2, 3)
        wide, narrow, finest = C
        slope = narrow + (narrow - wide) / (RATIO**2 - 1.0)
        size = found.size.max(axis=0)
        noise = (4 * _resolution(found) * size / found.ahead[-1]).swapaxes(1, 2)
        # The finest step finds what the wide ones step over.
        apart = np.abs(slope - finest) - noise
        # What is extrapolated is no better than a part of its last correction.
        correction = np.abs(slope - narrow)
        apart = np.maximum(apart, QUICKLY * correction / SMALL)
        largest = np.abs(slope).max(axis=2, keepdims=True)
        apart = apart / not_small(np.abs(slope), largest)
        # An output that does not move is flat: most do not depend on that number. So is a function
        # that is constant in pieces, as by np.round, within one of them, which `flat` of a
        # measurement tells the user; and 0 is a slope of abs(x) at 0.
        still = (C == 0.0).all(axis=0)
        return slope, np.where(still, 0.0, apart).max(axis=1)


def along_units(scale: Array, rows: int) -> Array:
    """Returns the directions (rows, n, n) of each number, with its widest step."""
    n = len(scale)
    return np.broadcast_to(np.diag(scale), (rows, n, n))


def single(values: Array) -> Mask:
    """Tells of each value whether it has no more digits than single precision holds."""
    with np.errstate(all="ignore"):
        return values == values.astype(np.float32)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Leaves out warnings: a function may be asked outside of where it is defined."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def not_small(size: Array, largest: Array) -> Array:
    """Returns sizes of slopes, none of them small beside the largest of its output."""
    return np.maximum(size, SMALL * largest)


class Sampled(NamedTuple):
    """Holds the values of a function at steps along directions, level by level of a ladder, and
    next to where it begins."""

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
    """The values of neighbours (neighbours, rows, p, m)."""

    @property
    def central(self) -> Array:
        """Central differences (levels, rows, p, m)."""
        return (self.up - self.down) / (self.ahead + self.behind)

    @property
    def forward(self) -> Array:
        """Differences of the side ahead, likewise."""
        return (self.up - self.here) / self.ahead

    @property
    def backward(self) -> Array:
        """Differences of the side behind, likewise."""
        return (self.here - self.down) / self.behind

    @property
    def size(self) -> Array:
        """The largest magnitude of the values at each step (levels, rows, p, m)."""
        moved = np.maximum(np.abs(self.up), np.abs(self.down))
        return np.maximum(np.abs(self.here), moved)


def sampled(
    h: Rows,
    x: Array,
    directions: Array,
    near: Near,
    parts: Array,
    beside: Array = _NOWHERE,
) -> Sampled:
    """Computes h at x, at `parts` of the directions ahead and behind, and at other parts `beside`,
    in one call."""
    rows, p, n = directions.shape
    steps = parts[:, None, None, None] * directions
    begin = x[:, None]
    above = begin + steps
    below = begin - steps
    neighbours = begin + beside[:, None, None, None] * directions
    places = (x, neighbours, above, below)
    points = np.concatenate([one.reshape(-1, n) for one in places])
    values = np.asarray(h(points), dtype=float)
    ends = np.cumsum([one.size // n for one in places])
    value, of_neighbours, up, down = np.split(values, ends[:-1])
    here = value[:, None]

    def placed(given: Array, count: int) -> Array:
        shaped = given.reshape(count, rows, p, values.shape[1])
        return near(shaped, np.broadcast_to(here, shaped.shape))

    # x + step is rounded: the step that was taken is what is left of it after taking off x.
    length = np.abs(directions).sum(axis=2)
    ahead = np.abs(above - begin).sum(axis=3) / length
    behind = np.abs(below - begin).sum(axis=3) / length
    return Sampled(
        here,
        placed(up, len(parts)),
        placed(down, len(parts)),
        ahead[..., None],
        behind[..., None],
        placed(of_neighbours, len(beside)),
    )


def _noise(found: Sampled) -> Array:
    """Estimates by how much the noise of the values moves differences (levels, rows, p, m)."""
    rounding = 2 * _resolution(found) * found.size
    scatter = 3 * _scatter(found.here, found.beside)
    return np.fmax(rounding, scatter) / found.ahead


def _resolution(found: Sampled) -> Array:
    """Returns the relative distance (rows, p, m) of neighbouring values: that of single precision
    where all that move have no more digits."""
    here, up, down, *_ = found
    short = single(here) & single(up).all(axis=0) & single(down).all(axis=0)
    moves = (up != here).any(axis=0) | (down != here).any(axis=0)
    return np.where(short & moves, np.finfo(np.float32).eps, _EPS)


def _scatter(here: Array, beside: Array) -> Array:
    """Estimates the noise (rows, p, m) of values, by high differences of neighbours, which smooth
    functions lack (More and Wild, SIAM J. Sci. Comput. 33, 2011)."""
    middle = np.broadcast_to(here, beside[:1].shape)
    line = np.concatenate([beside[:3], middle, beside[3:]])
    # The squares of the coefficients of these differences add up to 70 and to 252.
    fourth = np.diff(line, 4, axis=0) / math.sqrt(70)
    fifth = np.diff(line, 5, axis=0) / math.sqrt(252)
    return np.sqrt(np.maximum((fourth**2).mean(axis=0), (fifth**2).mean(axis=0)))


def _blur(x: Array, directions: Array) -> Array:
    """Returns the round-off (rows, p, 1) of the numbers that a direction moves, in parts of it: a
    step of a few such units is no step along the direction."""
    moving = np.where(directions != 0, np.abs(x)[:, None], 0.0).max(axis=2)
    widest = np.abs(directions).max(axis=2)
    return (_EPS * moving / widest)[:, :, None]


class _Column(NamedTuple):
    """Holds differences that are extrapolated k times: one for each of the levels but k."""

    value: Array
    error: Array
    """What is left of the error, by how far the last extrapolation moved them."""
    noise: Array


def _columns(C: Array, noise: Array, order: int) -> Iterator[_Column]:
    """Yields differences C (levels, ...) as they are, then extrapolated once, twice, three times
    (Richardson). Their error is a series in the step to the power of `order`, of which each
    extrapolation takes off a term."""
    none = np.full((1, *C.shape[1:]), np.inf)
    column = _Column(C, np.concatenate([none, np.abs(np.diff(C, axis=0))]), noise)
    yield column
    for k in range(1, _COLUMNS + 1):
        gain = RATIO ** (order * k)
        wide = column.value[:-1]
        narrow = column.value[1:]
        value = narrow + (narrow - wide) / (gain - 1.0)
        error = np.maximum(np.abs(value - narrow), np.abs(value - wide) / gain)
        grown = column.noise[1:] * (1 + 2 / (gain - 1.0))
        column = _Column(value, error, grown)
        yield column


def _limit(C: Array, noise: Array, order: int) -> Limit:
    """Extrapolates differences C (levels, ...) of shrinking steps, each with its noise, and takes
    the value of the least error; the slope of the finest step, with an infinite error, if none has
    an error that is finite.

    Of levels 0, 1, 2, ... from wide to fine, the i-th value of the k-th column has

        steps used    i to i + k
        moved there   moved[i - 1] to moved[i + k - 1], by a step from the one before
        seen finer    levels i + k + 1 and on
    """
    moved = np.abs(np.diff(C, axis=0))
    # What moves beyond noise from each step to finer ones, at the most.
    beyond = moved - 3 * (noise[:-1] + noise[1:])
    later = np.fmax.accumulate(beyond[::-1], axis=0)[::-1]
    best = C[-1]
    least = np.full(C.shape[1:], np.inf)
    for k, column in enumerate(_columns(C, noise, order)):
        for i, value in enumerate(column.value):
            # The value is made of the steps from level i to level i + k.
            finest = i + k
            error = column.error[i] + column.noise[i]
            # Wide steps say nothing of a function that moves more at finer ones, or elsewhere.
            if 0 < finest < len(moved):
                used = moved[max(0, i - 1) : finest].max(axis=0)
                unseen = later[finest]
                error = np.where(unseen > used, np.maximum(error, unseen), error)
            # Nor is a value right from which the differences of finer steps stay away.
            after = finest + 1
            if after < len(moved):
                away = np.abs(value - C[after:-1])
                allowed = 2 * moved[after:] + 3 * noise[after:-1]
                error = np.maximum(error, np.fmax.reduce(away - allowed, axis=0))
            better = error < least
            best = np.where(better, value, best)
            least = np.where(better, error, least)
    return Limit(best, least)


def _settled(central: Limit, ahead: Limit, behind: Limit) -> Limit:
    """Believes the sides where they agree and central differences do not agree with them: the error
    of these is not even in the step where the curvature jumps."""
    mean = (ahead.slope + behind.slope) / 2
    error = np.maximum(ahead.error, behind.error)
    smooth = np.abs(ahead.slope - behind.slope) <= 3 * (ahead.error + behind.error)
    sides = smooth & (error < np.abs(central.slope - mean))
    slope = np.where(sides, mean, central.slope)
    return Limit(slope, np.where(sides, error, central.error))


def _by_output(one: Limit) -> Limit:
    """Turns slopes (rows, p, m) into slopes (rows, m, p), as Jacobians are."""
    return Limit(one.slope.swapaxes(1, 2), one.error.swapaxes(1, 2))


def _by_ladders(h: Rows, x: Array, scale: Array, near: Near) -> Array:
    """Computes slopes (rows, m, n) per widest step by the whole ladder, and where it leaves an
    error by a second ladder, which begins near the end of the first."""
    directions = along_units(scale, len(x))
    first = measured(h, x, directions, near).central
    slope = first.slope.copy()
    with np.errstate(all="ignore"):
        size = np.abs(slope)
        largest = np.fmax.reduce(size, axis=2, keepdims=True)
        settled = first.error <= TOLERANCE * not_small(size, largest)
        rows = np.flatnonzero(~settled.all(axis=(1, 2)))
        if rows.size:
            part = RATIO ** (LEVELS - 2)
            second = measured(h, x[rows], directions[rows] / part, near).central
            finer = part * second.slope
            error = part * second.error
            # A second round must agree with the first within its error.
            agrees = ~(np.abs(finer - slope[rows]) > 3 * first.error[rows])
            better = agrees & (error < first.error[rows])
            slope[rows] = np.where(better, finer, slope[rows])
    return slope
