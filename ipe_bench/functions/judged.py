"""A user's function whose slopes are held against differences wherever they are used."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
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
    unmoved,
)

_EPS = np.finfo(float).eps
_COMPLEX_STEP = 1e-30
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
    while begun < rows or not parts:
        points = x[begun : begun + few, None, :] + np.eye(n) * _COMPLEX_STEP * 1j
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
        rows = np.flatnonzero(self.wrong(x, value, J))
        if rows.size:
            J[rows] = self.differences(x[rows])
        return value, J

    def _by_complex_steps(self, x: Array) -> Array:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", np.exceptions.ComplexWarning)
            return by_complex_steps(self.function, x)

    def differences(self, x: Array) -> Array:
        return by_differences(self.function, x, self.scale, self.near)

    def wrong(self, x: Array, value: Array, J: Array) -> Mask:
        """Finds the rows (rows,) of x whose values or slopes are not the function's own: along one
        direction, and where that leaves a doubt, along each."""
        with np.errstate(all="ignore"):
            per_step = np.abs(J) * self.scale
            per_step = np.where(np.isfinite(per_step), per_step, 0.0)
            along = _NARROW * self.scale * _direction(per_step)
            z = np.asarray(self.function(np.concatenate([x, x + along, x - along])), dtype=float)
            here, up, down = np.split(z, 3)
            # The terms of an output may be larger than it is.
            size = np.abs(here) + (per_step * (1.0 + np.abs(x) / self.scale)[:, None]).sum(axis=2)
            alike = np.abs(self.near(value, here) - here) <= _VALUES * size
            both = ~np.isfinite(value) & ~np.isfinite(here)
            wrong = ~(alike | both).all(axis=1)
            moved = (J * along[:, None]).sum(axis=2)
            ahead = self.near(up, here) - here
            behind = self.near(down, here) - here
            change = (ahead - behind) / 2
            bend = np.abs(ahead + behind) / 2
            # A difference of one step is off by about its bend squared, but at kinks.
            most = np.fmin(bend, 4 * bend**2 / np.abs(change))
            allowed = most + _SLOPES * np.abs(change) + 8 * _EPS * size
            doubt = np.isfinite(here) & ~(np.abs(change - moved) <= allowed)
            rows = np.flatnonzero(doubt.any(axis=1) & ~wrong)
            if rows.size:
                wrong[rows] = self.contradicted(x[rows], J[rows])
        return wrong

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
    weight = weight / weight.max(axis=1, keepdims=True)
    rng = np.random.default_rng(1)
    return weight * rng.uniform(0.5, 1.0, n) * rng.choice([-1.0, 1.0], n)


def same_values(a: Array, b: Array) -> bool:
    """Tells whether values (rows, m) are the same to round-off of the largest of their row."""
    with np.errstate(all="ignore"):
        size = np.abs(np.where(np.isfinite(b), b, 0.0)).max(axis=1, keepdims=True)
        alike = (np.abs(a - b) <= _VALUES * size) | (a == b) | (np.isnan(a) & np.isnan(b))
        return bool(alike.all())


def judged(
    function: Rows, points: Array, scale: Array, near: Near = unmoved, what: str = "the function"
) -> Judged:
    """Returns a function with slopes by complex steps, or by differences if it takes none, or they
    are wrong at most of the points (rows, n).

    Raises:
        UserError: the function is random, or mixes rows.
    """
    require_by_row(function, points, what)
    tried = Judged(function, scale, near)
    with np.errstate(all="ignore"):
        value = np.asarray(tried(points), dtype=float)
        try:
            J = tried._by_complex_steps(points)
        except Exception as error:
            return replace(tried, why=f"it takes no complex numbers ({type(error).__name__})")
        if 2 * tried.wrong(points, value, J).sum() > len(points):
            return replace(tried, why="complex steps find other slopes than differences")
    return tried


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
