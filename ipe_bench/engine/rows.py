"""Runs recorded functions of rows of numbers, with their slopes, in machine code.

The bits of a row depend on its own numbers alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial, reduce
from itertools import product
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array, own
from ipe_bench.engine import compiled
from ipe_bench.engine.compiled import INTEGER, POINTER, at
from ipe_bench.engine.integrator import emitted
from ipe_bench.engine.trace import Graph, RowPrograms

_ARGUMENTS = (POINTER, POINTER, INTEGER, POINTER, POINTER, POINTER, INTEGER)


@dataclass(frozen=True)
class RowFunction:
    """A function y(x, c) of rows: of x (rows, n), by which it is differentiated, and c (count, p),
    of which row i takes number i modulo count. Both lie in memory as compiled code takes them."""

    programs: RowPrograms

    def __getstate__(self) -> dict[str, Any]:
        """Leaves machine code behind, which does not leave the process."""
        return {"programs": self.programs}

    def __call__(self, x: Array, c: Array) -> Array:
        """Computes y (rows, m)."""
        self._require_width(x)
        y = np.empty((len(x), self.programs.m))
        self._compiled(at(x), at(c), len(c), None, at(y), None, len(x))
        return y

    def slopes(self, x: Array, c: Array) -> tuple[Array, Array]:
        """Computes y (rows, m) and dy/dx (rows, m, n)."""
        self._require_width(x)
        rows, n = x.shape
        y = np.empty((rows, self.programs.m))
        J = np.empty((*y.shape, n))
        self._compiled(at(x), at(c), len(c), at(self._directions), at(y), at(J), rows)
        return y, J

    def _require_width(self, x: Array) -> None:
        """Raises ValueError unless x is (rows, n): compiled code would read beyond it."""
        n = self.programs.n
        if x.shape[1] != n:
            raise ValueError(f"rows of {x.shape[1]} numbers, where {n} belong")

    @cached_property
    def _directions(self) -> Array:
        return np.eye(self.programs.n)

    @cached_property
    def _compiled(self) -> Callable[..., None]:
        return emitted("rows", self.programs, min(self.programs.n, compiled.width()), _ARGUMENTS)


def products(M: Array, x: Array) -> Array:
    """Computes M x (trials, K, p) or (trials, K, p, r) of small matrices M (K, p, n) or (trials, K,
    p, n) and of x (trials, K, n) or (trials, K, n, r): in machine code in a fifth of the time of
    NumPy's stacked products."""
    p, n = M.shape[-2:]
    columns = x.shape[3:]
    if not M.size:
        return np.zeros((*x.shape[:2], p, *columns))
    r = columns[0] if columns else 1
    y = _product(p, n, r)(own(x.reshape(-1, n * r)), own(M.reshape(-1, p * n)))
    return y.reshape(*x.shape[:2], p, *columns)


@cache
def _product(p: int, n: int, r: int) -> RowFunction:
    """Returns y_ic = sum_j M_ij x_jc as a function of rows."""
    graph = Graph()
    x = graph.inputs("x", n * r)
    M = graph.inputs("M", p * n)
    y = []
    for i, c in product(range(p), range(r)):
        along = M[i * n : (i + 1) * n]
        terms = map(partial(graph.apply, "mul"), along, x[c::r])
        y.append(reduce(partial(graph.apply, "add"), terms))
    return RowFunction(RowPrograms.of(y, x, M))
