"""A user's function whose slopes are held against differences wherever they are used."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Mask, read_only
from ipe_bench.functions.differences import (
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
_COMPLEX_STEP = 1e-100
_AT_ONCE = 16384
"""Bytes of slopes that are computed in a call of a function by complex steps."""
_NARROW = 1e-3
"""Part of the widest steps by which slopes are tried along one direction."""
_BESIDE_A_KINK = 1e-3
"""Part of the widest steps from which on they are narrow."""
_VALUES = 1e-10
"""Part of the size of an output's terms by which values may differ that are the same."""
_SLOPES = 1e-6
"""Part of a change along that direction by which slopes may differ without a doubt."""
_MIXED = 1e-6
"""The same, of a row alone and among others."""
_QUICKLY = 1e-7
"""Part of a slope by which few differences may disagree in a smooth function, at the least."""
_ROUGH = 1e-2
"""The same at the most, in one that is rough, such as by an integrator's tolerance."""
_NOISIEST = 1e-5
"""Part of an output's terms by which a function may be rough."""
_PARTS = 3.0 ** -np.arange(0.0, 16.0, 3.0)
"""Parts of rough widest steps that are tried."""
_NARROWER = 3.0**-9
_MANY_LEVELS = 20
_LEAST = 1e-4
"""Part of the largest slope below which no slope counts as smaller in that direction."""


def by_complex_steps(h: Rows, x: Array) -> Array:
    """Computes dh/dx (rows, m, n) of an analytic function as Im h(x + i eps e_k) / eps, exact to
    round-off (Squire and Trapp, SIAM Review 40, 1998)."""
    rows, n = x.shape
    # A few rows in a call: NumPy multiplies complex numbers with other rounding where it reuses a
    # large temporary array for the product, so in one call of all the bits of each would depend on
    # how many there are.
    parts: list[Array] = []
    begun = 0
    few = 1
    steps = np.eye(n) * _COMPLEX_STEP * 1j
    while begun < rows or not parts:
        points = x[begun : begun + few, None, :] + steps
        moved = np.imag(h(read_only(points.reshape(-1, n))))
        parts.append(moved.reshape(len(points), n, moved.shape[-1]).swapaxes(1, 2))
        begun += few
        few = max(1, int(_AT_ONCE / max(parts[0][:1].nbytes, 1)))
    return np.ascontiguousarray(np.concatenate(parts)) / _COMPLEX_STEP


@dataclass(frozen=True)
class Judged:
    """A function of rows (rows, n) that knows its slopes: those of complex steps where differences
    do not contradict them, else those of differences."""

    function: Rows
    scale: Array
    """The widest steps (n,) of differences: deviations, or parts of values."""
    near: Near = unmoved
    why: str = ""
    """Why its slopes are differences; empty if complex steps are tried."""
    noise: float = 0.0
    """Part of an output's terms by which it is rougher than round-off."""
    within: float = _QUICKLY
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
            J = self._by_complex_steps(x)
        except Exception:  # functions of `math` and many of SciPy take no complex numbers
            return value, self.differences(x)
        rows = np.flatnonzero(self._wrong_slopes(x, value, J))
        if rows.size:
            J[rows] = self.differences(x[rows])
        return value, J

    def _by_complex_steps(self, x: Array) -> Array:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", np.exceptions.ComplexWarning)
            return by_complex_steps(self.function, x)

    def differences(self, x: Array) -> Array:
        if self.steps is not None:
            return by_steps(self.function, x, self.steps, self.near)
        return by_differences(self.function, x, self.scale, self.near, self.within)

    @property
    def differences_cost(self) -> float:
        """Calls of a row's differences, but where they doubt themselves."""
        return float((6 if self.steps is None else 2) * len(self.scale) + 1)

    def wrong(self, x: Array, value: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x whose values or slopes are not the function's own."""
        with np.errstate(all="ignore"):
            here = np.asarray(self.function(x), dtype=float)
            alike = np.abs(self.near(value, here) - here) <= _VALUES * self._size(x, here, J)
            both = ~np.isfinite(value) & ~np.isfinite(here)
            wrong: Mask = np.any(~(alike | both), axis=1)
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

    def _size(self, x: Array, here: Array, J: Array) -> Array:
        """Returns the size (rows, m) of the terms of the outputs, which may be larger than
        these."""
        terms = np.abs(J) * (self.scale + np.abs(x))[:, None]
        return np.abs(here) + np.where(np.isfinite(terms), terms, 0.0).sum(axis=2)

    def _doubted(self, x: Array, here: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x where slopes do not tell what the function, whose values are
        `here`, does along one direction."""
        with np.errstate(all="ignore"):
            rough = self._roughness(x, here, J)
            beyond = ~(rough <= max(8 * _EPS, self.noise))
            return (np.isfinite(here) & beyond).any(axis=1)

    def _roughness(self, x: Array, here: Array, J: Array) -> Array:
        """Computes by which part of their terms the outputs (rows, m) move otherwise than slopes
        tell."""
        per_step = np.abs(J) * self.scale
        per_step = np.where(np.isfinite(per_step), per_step, 0.0)
        along = _NARROW * self.scale * _direction(per_step)
        z = np.asarray(self.function(np.concatenate([x + along, x - along])), dtype=float)
        up = z[: len(x)]
        down = z[len(x) :]
        moved = (J * along[:, None]).sum(axis=2)
        ahead = self.near(up, here) - here
        behind = self.near(down, here) - here
        change = (ahead - behind) / 2
        bend = np.abs(ahead + behind) / 2
        # A difference of one step is off by about its bend squared, but at kinks.
        most = np.fmin(bend, 4 * bend**2 / np.abs(change))
        allowed = most + _SLOPES * np.abs(change)
        away = np.maximum(np.abs(change - moved) - allowed, 0.0)
        if not away.any():
            return away
        return np.where(away == 0.0, 0.0, away / self._size(x, here, J))

    def contradicted(self, x: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x with a slope that differences along each number find wrong,
        and narrow ones do not find right: next to a kink wide ones take the slopes of both
        sides."""
        wrong = self._verdicts(x, J, 1.0) == WRONG
        rows = np.flatnonzero(wrong.any(axis=(1, 2)))
        if rows.size:
            wrong[rows] &= self._verdicts(x[rows], J[rows], _BESIDE_A_KINK) != RIGHT
        return wrong.any(axis=(1, 2))

    def _verdicts(self, x: Array, J: Array, part: float) -> Array:
        directions = along_units(part * self.scale, len(x))
        found = measured(self.function, x, directions, self.near)
        with np.errstate(all="ignore"):
            return judge(J * (part * self.scale), found)


def _direction(per_step: Array) -> Array:
    """Returns parts (rows, n) of the widest steps by which every number changes the outputs by
    about as much, none by a multiple of what another does, so that a wrong column shows beside
    larger ones."""
    n = per_step.shape[2]
    largest = per_step.max(axis=1, initial=0.0) + np.finfo(float).tiny
    weight = 1.0 / np.maximum(largest, _LEAST * largest.max(axis=1, keepdims=True))
    return weight / weight.max(axis=1, keepdims=True) * _signed_parts(n)


@cache
def _signed_parts(n: int) -> Array:
    """Returns numbers (n,) from .5 to 1 of both signs, always the same."""
    rng = np.random.default_rng(1)
    return read_only(rng.uniform(0.5, 1.0, n) * rng.choice([-1.0, 1.0], n))


def same_values(a: Array, b: Array) -> bool:
    """Tells whether values (rows, m) are the same to round-off of the largest of their row."""
    with np.errstate(all="ignore"):
        size = np.abs(np.where(np.isfinite(b), b, 0.0)).max(axis=1, keepdims=True)
        alike = (np.abs(a - b) <= _VALUES * size) | (a == b) | (np.isnan(a) & np.isnan(b))
        return bool(alike.all())


def with_differences(function: Rows, points: Array, scale: Array, near: Near = unmoved) -> Judged:
    """Returns a function with the differences that suit it at most of the points (rows, n)."""
    with np.errstate(all="ignore"):
        # How far few differences may disagree is what they do there.
        apart = quick(function, points, scale, near)[1].max(axis=1)
        usual = float(np.median(np.where(np.isfinite(apart), apart, np.inf)))
        within = min(max(_QUICKLY, 3 * usual), _ROUGH) if usual < _ROUGH else _QUICKLY
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
            J = tried._by_complex_steps(points)
        except Exception as error:
            return replace(tried, why=f"it takes no complex numbers ({type(error).__name__})")
        wrong = tried._wrong_slopes(points, value, J)
        if 2 * wrong.sum() > len(points):
            return replace(tried, why="complex steps find other slopes than differences")
        rough = tried._roughness(points, value, J)[~wrong]
        noise = 3 * float(np.where(np.isfinite(rough), rough, 0.0).max(initial=0.0))
        return replace(tried, noise=min(noise, _NOISIEST))


def widest_steps(h: Rows, x: Array, rough: Array, near: Near = unmoved) -> Array:
    """Finds the widest steps (n,) for differences at x (n,): parts of rough ones at which few
    differences find the slopes in nearly all outputs."""
    here = x[None]
    with np.errstate(all="ignore"):
        wide = quick(h, here, rough, near)[0][0]
        narrow = quick(h, here, _NARROWER * rough, near)[0][0] / _NARROWER
        # Wide steps may step over what only narrow ones find.
        if (np.abs(wide - narrow) <= 1e-3 * np.abs(narrow).max(axis=1, keepdims=True)).all():
            return rough
        slope, error = measured(h, here, along_units(rough, 1), near, _MANY_LEVELS).central
        largest = np.abs(slope[0]).max(axis=1, keepdims=True)
        allowed = np.maximum(3 * error[0], 1e-6 * np.maximum(np.abs(slope[0]), 1e-3 * largest))
        best = _PARTS[-1] * rough
        most = np.full(len(rough), 0.0)
        for part in _PARTS:
            found = quick(h, here, part * rough, near)[0][0] / part
            share = (np.abs(found - slope[0]) <= allowed).mean(axis=0)
            better = share > most + 0.01
            best = np.where(better, part * rough, best)
            most = np.where(better, share, most)
    return best


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
        alone: Any = [np.asarray(function(row[None]), dtype=float) for row in points]
        size = np.abs(np.where(np.isfinite(together), together, 0.0)).max(axis=1, keepdims=True)
        apart = np.abs(together - np.concatenate(alone))
        both = ~np.isfinite(together) & ~np.isfinite(np.concatenate(alone))
        if not (both | (apart <= _MIXED * size)).all():
            raise UserError(
                f"{what}: gives a row other values among others than alone; compute each row (the"
                " last axis) by itself, such as by x - np.mean(x, axis=-1, keepdims=True)"
            )
