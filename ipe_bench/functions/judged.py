"""A user's function whose slopes are held against differences wherever they are used.

Slopes by complex steps are exact where a function is analytic, and wrong without a word where it
is not, as at np.abs. So at every point where they are used they are tried in two stages. Two more
values, along one direction that moves all numbers, tell what slopes should have told; that costs
little, and leaves a doubt where it does not agree. Only in doubt are differences taken along each
number by itself, which find slopes wrong (a *contradiction*), and take their place.

    stage           values a row  compared with     a row goes on if they are apart by more than
    _doubted        2             slopes along      _SLOPES of the change, its bend, and round-off
                                  one direction     or `noise` of the output's terms; or if `noise`
                                                    hides _HIDDEN of the change
    contradicted    25 a number   slopes along      3 errors of the differences, and narrow ones,
                                  each number       of _BESIDE_A_KINK, do not find them right
    differences                                     these are the slopes of a row that comes here

Where differences tell nothing of a slope, that of complex steps stays.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Mask, read_only
from ipe_bench.functions.complex_steps import by_complex_steps
from ipe_bench.functions.differences import (
    QUICKLY,
    RIGHT,
    WRONG,
    Near,
    Rows,
    along_units,
    by_differences,
    judge,
    measured,
    quick,
    unmoved,
)
from ipe_bench.functions.rough import Steps, by_steps, steps_of_a_rough_function

_EPS = np.finfo(float).eps
_TINY = np.finfo(float).tiny
_VALUES = 1e-10
"""Part of the size of an output's terms by which values may differ that are the same."""
_MIXED = 1e-6
"""The same, of a row alone and among others."""
_NARROW = 1e-3
"""Part of the widest steps by which slopes are tried along one direction."""
_SLOPES = 1e-6
"""Part of a change along that direction by which slopes may differ without a doubt."""
_LEAST = 1e-4
"""Part of the largest slope below which no slope counts as smaller in that direction."""
_BESIDE_A_KINK = 1e-3
"""Part of the widest steps from which on they are narrow."""
_ROUGH = 1e-2
"""Part of a slope by which few differences may disagree at the most, in a function that is rough,
such as by an integrator's tolerance; `QUICKLY` at the least, in a smooth one."""
_NOISIEST = 1e-5
"""Part of an output's terms by which a function may be rough."""
_HIDDEN = 0.1
"""Part of a change along that direction that roughness may hide; where it hides more, such as among
numbers that vary by little of themselves, the direction tells nothing, and that is a doubt."""


@dataclass(frozen=True)
class Judged:
    """A function of rows (rows, n) that knows its slopes: those of complex steps where differences
    do not contradict them, else those of differences.

    Complex steps are tried unless `why` is given; `noise` is what they need not tell. Differences
    are central ones of `steps` if these are given, else three that must agree `within` a part, or
    a whole ladder.
    """

    function: Rows
    scale: Array
    """The widest steps (n,) of differences: deviations, or parts of values."""
    near: Near = unmoved
    why: str = ""
    """Why its slopes are differences; empty if complex steps are tried."""
    noise: float = 0.0
    """Part of an output's terms by which it is rougher than round-off."""
    within: float = QUICKLY
    """Part of a slope by which few differences may disagree."""
    steps: Steps | None = None
    """Steps of differences if the function is rough, such as by an integrator's tolerance."""

    def __call__(self, x: Array) -> Array:
        return self.function(x)

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Computes values (rows, m) and slopes (rows, m, n)."""
        value = np.asarray(self.function(x))
        if self.why:
            return value, self.differences(x)
        try:
            J = self.complex_slopes(x)
        except Exception:  # functions of `math` and many of SciPy take no complex numbers
            return value, self._slopes_by_halves(x)
        rows = np.flatnonzero(self._wrong_slopes(x, value, J))
        if rows.size:
            J[rows] = self.differences(x[rows])
        return value, J

    def _slopes_by_halves(self, x: Array) -> Array:
        """Computes slopes (rows, m, n) where a row takes no complex numbers: of that row by
        differences, and of the others as without it."""
        if len(x) == 1:
            return self.differences(x)
        return np.concatenate([self.slopes(half)[1] for half in np.array_split(x, 2)])

    def complex_slopes(self, x: Array) -> Array:
        """Computes slopes (rows, m, n) by complex steps, believed or not; a function that takes no
        complex numbers raises what it likes."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", np.exceptions.ComplexWarning)
            return by_complex_steps(self.function, x)

    def differences(self, x: Array) -> Array:
        """Computes slopes (rows, m, n) by the differences that suit the function."""
        if self.steps is not None:
            return by_steps(self.function, x, self.steps, self.near)
        return by_differences(self.function, x, self.scale, self.near, self.within)

    @property
    def differences_cost(self) -> float:
        """Calls of a row's differences, but where they doubt themselves: three central differences
        of a number in `by_differences`, one in `by_steps`."""
        each = 6 if self.steps is None else 2
        return float(each * len(self.scale) + 1)

    def wrong(self, x: Array, value: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x whose values or slopes are not the function's own."""
        with np.errstate(all="ignore"):
            here = np.asarray(self.function(x), dtype=float)
            allowed = _VALUES * self._terms(x, here, J)
            alike = np.abs(self.near(value, here) - here) <= allowed
            missing = ~np.isfinite(value) & ~np.isfinite(here)
            wrong: Mask = np.any(~(alike | missing), axis=1)
            right = np.flatnonzero(~wrong)
            wrong[right] = self._wrong_slopes(x[right], here[right], J[right])
        return wrong

    def _wrong_slopes(self, x: Array, here: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x whose slopes are not those of the function, whose values are
        `here`: along one direction, and where that leaves a doubt, along each."""
        wrong = self._doubted(x, here, J)
        rows = np.flatnonzero(wrong)
        if rows.size:
            wrong[rows] = self.contradicted(x[rows], J[rows])
        return wrong

    def _doubted(self, x: Array, here: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x where slopes do not tell what the function, whose values are
        `here`, does along one direction."""
        with np.errstate(all="ignore"):
            rough, moves = self.roughness(x, here, J)
            beyond = ~(rough <= max(8 * _EPS, self.noise))
            hidden = (self.noise > _HIDDEN * moves) & (moves > 0.0)
            doubts: Mask = np.isfinite(here) & (beyond | hidden)
            return np.logical_or.reduce(doubts, axis=1)

    def roughness(self, x: Array, here: Array, J: Array) -> tuple[Array, Array]:
        """Computes by which part of their terms the outputs (rows, m), which are `here`, move
        otherwise along one direction than slopes tell, and by which part they move."""
        along = _NARROW * self.scale * _direction(_finite(np.abs(J) * self.scale))
        points = np.concatenate([x + along, x - along])
        values = np.asarray(self.function(points), dtype=float)
        up = values[: len(x)]
        down = values[len(x) :]
        ahead = self.near(up, here) - here
        behind = self.near(down, here) - here
        change = (ahead - behind) / 2
        bend = np.abs(ahead + behind) / 2
        told = (J * along[:, None]).sum(axis=2)
        # A difference of one step is off by about its bend squared, but at kinks by the bend.
        curved = np.fmin(bend, 4 * bend**2 / np.abs(change))
        allowed = curved + _SLOPES * np.abs(change)
        away = np.maximum(np.abs(change - told) - allowed, 0.0)
        moves = np.maximum(np.abs(change), np.abs(told))
        if not (away.any() or self.noise):
            return away, moves
        terms = self._terms(x, here, J)
        return np.where(away == 0.0, 0.0, away / terms), moves / terms

    def _terms(self, x: Array, here: Array, J: Array) -> Array:
        """Returns the size (rows, m) of the terms of the outputs, which may be larger than the
        outputs: of x - y, for one, that of x and of y."""
        sizes = (self.scale + np.abs(x))[:, None]
        return np.abs(here) + _finite(np.abs(J) * sizes).sum(axis=2)

    def contradicted(self, x: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x with a slope that differences along each number find wrong,
        and narrow ones do not find right: next to a kink wide ones take the slopes of both
        sides. In a rough function narrow ones find it right by chance at 3 to 6 of 100 points."""
        wrong = self._verdicts(x, J, 1.0) == WRONG
        rows = np.flatnonzero(wrong.any(axis=(1, 2)))
        if rows.size:
            by_narrow_ones = self._verdicts(x[rows], J[rows], _BESIDE_A_KINK)
            wrong[rows] &= by_narrow_ones != RIGHT
        return wrong.any(axis=(1, 2))

    def _verdicts(self, x: Array, J: Array, part: float) -> Array:
        """Says what differences, of a part of the widest steps, find of slopes (rows, m, n)."""
        widest = part * self.scale
        found = measured(self.function, x, along_units(widest, len(x)), self.near)
        with np.errstate(all="ignore"):
            return judge(J * widest, found)


def _direction(per_step: Array) -> Array:
    """Returns parts (rows, n) of the widest steps by which every number changes the outputs by
    about as much, none by a multiple of what another does, so that a wrong column shows beside
    larger ones; `per_step` is the size of the slopes (rows, m, n) per widest step."""
    n = per_step.shape[2]
    effect = per_step.max(axis=1, initial=0.0) + _TINY
    least = _LEAST * effect.max(axis=1, keepdims=True)
    weight = 1.0 / np.maximum(effect, least)
    return weight / weight.max(axis=1, keepdims=True) * _signed_parts(n)


@cache
def _signed_parts(n: int) -> Array:
    """Returns numbers (n,) from 0.5 to 1 of both signs, always the same."""
    rng = np.random.default_rng(1)
    return read_only(rng.uniform(0.5, 1.0, n) * rng.choice([-1.0, 1.0], n))


def with_differences(function: Rows, points: Array, scale: Array, near: Near = unmoved) -> Judged:
    """Returns a function with the differences that suit it at most of the points (rows, n)."""
    with np.errstate(all="ignore"):
        # How far few differences may disagree is what they do there.
        apart = quick(function, points, scale, near)[1].max(axis=1)
        usual = float(np.median(np.where(np.isfinite(apart), apart, np.inf)))
        within = QUICKLY
        if usual < _ROUGH:
            within = min(max(QUICKLY, 3 * usual), _ROUGH)
        steps = None
        if not (apart <= within).all():
            steps = steps_of_a_rough_function(function, points, scale, near)
        return Judged(function, scale, near, within=within, steps=steps)


def judged(
    function: Rows, points: Array, scale: Array, near: Near = unmoved, what: str = "the function"
) -> Judged:
    """Returns a function with slopes by complex steps, or by differences if it takes none, or they
    are wrong at most of the points (rows, n).

    Raises:
        UserError: the function is random, or mixes rows.
    """
    require_by_row(function, points, what)
    with np.errstate(all="ignore"):
        tried = with_differences(function, points, scale, near)
        value = np.asarray(tried(points), dtype=float)
        try:
            J = tried.complex_slopes(points)
        except Exception as error:
            return replace(tried, why=f"it takes no complex numbers ({type(error).__name__})")
        wrong = tried._wrong_slopes(points, value, J)
        if 2 * wrong.sum() > len(points):
            return replace(tried, why="complex steps find other slopes than differences")
        # Where slopes are right, what they do not tell is the roughness of the function.
        rough, _ = tried.roughness(points, value, J)
        noise = 3 * float(_finite(rough[~wrong]).max(initial=0.0))
        return replace(tried, noise=min(noise, _NOISIEST))


def same_values(a: Array, b: Array) -> bool:
    """Tells whether values (rows, m) are the same to round-off of the largest of their row."""
    with np.errstate(all="ignore"):
        alike = np.abs(a - b) <= _VALUES * _largest(b)
        missing = np.isnan(a) & np.isnan(b)
        return bool((alike | (a == b) | missing).all())


def require_by_row(function: Rows, points: Array, what: str) -> None:
    """Raises UserError if a function gives points (rows, n) other values the second time, or one by
    one."""
    with np.errstate(all="ignore"):
        together = np.asarray(function(points), dtype=float)
        again = np.asarray(function(points), dtype=float)
        if not np.array_equal(together, again, equal_nan=True):
            raise UserError(
                f"{what}: gives other values each time it is called; take random numbers and"
                " counters out of it: noise is drawn by the tool"
            )
        alone = np.concatenate([np.asarray(function(row[None]), dtype=float) for row in points])
        alike = np.abs(together - alone) <= _MIXED * _largest(together)
        missing = ~np.isfinite(together) & ~np.isfinite(alone)
        if not (alike | missing).all():
            raise UserError(
                f"{what}: gives a row other values among others than alone; compute each row (the"
                " last axis) by itself, such as by x - np.mean(x, axis=-1, keepdims=True)"
            )


def _finite(values: Array) -> Array:
    """Returns values with 0 in place of those that are not finite."""
    return np.where(np.isfinite(values), values, 0.0)


def _largest(values: Array) -> Array:
    """Returns the largest magnitude (rows, 1) of the finite values of each row."""
    return np.abs(_finite(values)).max(axis=1, keepdims=True)
