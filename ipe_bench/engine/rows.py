"""Runs recorded functions of rows of numbers, with their slopes: in machine code, or by NumPy where none can be made.

The bits of a row depend on its own numbers alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.engine import compiled
from ipe_bench.engine.compiled import INTEGER, POINTER, at
from ipe_bench.engine.integrator import emitted
from ipe_bench.engine.trace import Expression, RowPrograms

_ARGUMENTS = (POINTER, POINTER, INTEGER, POINTER, POINTER, POINTER, INTEGER)


@dataclass(frozen=True)
class RowFunction:
    """A function y(x, c) of rows: of x (rows, n), by which it is differentiated, and c (count, p), of which row i takes
    number i modulo count. Both lie in memory as compiled code takes them."""

    plain: RowPrograms
    sloped: RowPrograms

    @classmethod
    def of(
        cls, y: Sequence[Expression], x: Sequence[Expression], c: Sequence[Expression]
    ) -> RowFunction:
        plain, sloped = (RowPrograms.of(y, x, c, sloped=sloped) for sloped in (False, True))
        return cls(plain, sloped)

    def __getstate__(self) -> dict[str, Any]:
        """Leaves machine code behind, which does not leave the process."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def m(self) -> int:
        return self.plain.m

    def __call__(self, x: Array, c: Array) -> Array:
        """Computes y (rows, m)."""
        y = np.empty((len(x), self.m))
        if compiled.available():
            self._values(at(x), at(c), len(c), None, at(y), None, len(x))
        else:
            y[:] = _columns(self.plain.values(_given(x, c)), (len(x),)).T
        return y

    def slopes(self, x: Array, c: Array) -> tuple[Array, Array]:
        """Computes y (rows, m) and dy/dx (rows, m, n)."""
        rows, n = x.shape
        y, J = np.empty((rows, self.m)), np.empty((rows, self.m, n))
        if compiled.available():
            self._slopes(at(x), at(c), len(c), at(self._directions), at(y), at(J), rows)
            return y, J
        assert self.sloped.tangents is not None
        found = self.sloped.values(_given(x, c))
        y[:] = _columns(found[: self.m], (rows,)).T
        # The directions are a further axis in front, (n, rows).
        along = self._directions[:, :, None]
        moved = self.sloped.tangents([*along, *found[self.m :]])
        J[:] = np.moveaxis(_columns(moved, (n, rows)), (0, 1, 2), (1, 2, 0))
        return y, J

    @functools.cached_property
    def _directions(self) -> Array:
        return np.eye(self.plain.n)

    @functools.cached_property
    def _values(self) -> Callable[..., None]:
        return emitted("rows", self.plain, 1, _ARGUMENTS)

    @functools.cached_property
    def _slopes(self) -> Callable[..., None]:
        return emitted("rows", self.sloped, min(self.plain.n, compiled.width()), _ARGUMENTS)


def _given(x: Array, c: Array) -> list[Array]:
    """Returns the columns of x and c, each in one piece of memory, on which a column's bits do not depend then."""
    known = c[np.arange(len(x)) % len(c)]
    return [*np.ascontiguousarray(x.T), *np.ascontiguousarray(known.T)]


def _columns(values: Sequence[Any], shape: tuple[int, ...]) -> Array:
    return np.array([np.broadcast_to(value, shape) for value in values]).reshape(-1, *shape)
