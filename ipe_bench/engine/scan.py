"""Runs recorded steps along the epochs of all trials, in machine code.

    void scan(double *carry, double *shared, double *out, int64 trials, int64 first, int64 by, int64
    count, int64 length, double *each, int64 its_length, int64 its_stride, ...)

At epoch first, first + by, ... the step takes what is carried, the numbers of its trial and epoch
in one or more arrays each (trials, its_length, its_stride) and those of its epoch in shared
(length, p), and gives what is carried on and out (trials, length, o). A lane is a trial; a group
that is not full repeats its last one. The bits of a trial depend on its own numbers alone.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from operator import add, mul
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.engine import compiled
from ipe_bench.engine.compiled import INTEGER, POINTER, at
from ipe_bench.engine.trace import Expression, Graph, Program

if TYPE_CHECKING:
    # Imported where something is compiled, and here so that results are known to depend on it.
    from ipe_bench.engine import emit as emit

_LARGE = 4_000
"""Products of a matrix operation from which on it is written as loops: straight lines would take
longer to compile than they save."""
_ARGUMENTS = (*[POINTER] * 3, *[INTEGER] * 5)
_OF_EACH = (POINTER, INTEGER, INTEGER)
_BYTES = 8
"""Of a number."""
_FILES = [Path(__file__), Path(__file__).with_name("trace.py"), *compiled.EMITTING]


@dataclass(frozen=True)
class Step:
    """A program that is run along epochs."""

    key: str
    """Stands for the program."""
    record: Callable[[], Program] = field(compare=False)
    """Records it, which is asked for only if it is not kept as machine code."""
    carried: int
    each: tuple[int, ...]
    """Numbers of its trial and epoch, of one or more arrays."""
    shared: int
    shown: int
    """Numbers of a trial and epoch that it gives."""

    def run(
        self,
        carry: Array,
        each: Sequence[Array],
        shared: Array,
        out: Array,
        first: int,
        by: int,
        count: int,
    ) -> None:
        """Advances carry (trials, carried) by `count` epochs. Arrays of each (trials, length, ...)
        that are shorter than the longest of them lack its first epochs, and the step takes the
        first numbers of an epoch."""
        trials, length, _ = out.shape
        if not trials or not count:
            return
        longest = max((one.shape[1] for one in each), default=0)
        arrays = []
        for one in each:
            its_length = one.shape[1]
            stride = one.size // (trials * its_length)
            begin = at(one) - _BYTES * stride * (longest - its_length)
            arrays += [begin, its_length, stride]
        run = _compiled(self)
        run(at(carry), at(shared), at(out), trials, first, by, count, length, *arrays)


@lru_cache(maxsize=256)
def _compiled(step: Step) -> Callable[..., None]:
    width = compiled.width()
    key = repr((step.key, width, compiled.digest_of(*_FILES)))

    def write() -> str:
        emit = importlib.import_module("ipe_bench.engine.emit")
        return emit.scan(step, step.record(), width)

    arguments = (*_ARGUMENTS, *_OF_EACH * len(step.each))
    return compiled.load(key, write, "scan", arguments)


Matrix = Sequence[Sequence[Any]]


def orthogonalised(W: Matrix, checked: int, small: float) -> list[list[Any]]:
    """Computes the triangular F (n, n) with F F' = W W' by orthogonal rows (modified Gram and
    Schmidt); of the first `checked` rows, those of which rows above leave less than a part `small`
    of their length become 0."""
    n = len(W)
    columns = len(W[0])
    graph = _large(W, n * n * columns)
    if graph is not None:
        sizes = (n, columns, checked, small)
        found = graph.block("orthogonalised", sizes, [a for row in W for a in row], n * n)
        return [[found[i * n + j] if j <= i else 0.0 for j in range(n)] for i in range(n)]
    rows = [list(row) for row in W]
    F: list[list[Any]] = [[0.0] * n for _ in W]
    least = [dot(row, row) * small**2 for row in rows[:checked]]
    for i, row in enumerate(rows):
        square = dot(row, row)
        if i < checked:
            square = np.where(np.less_equal(square, least[i]), 0.0, square)
        none = np.less_equal(square, 0.0)
        length = np.sqrt(square)
        inverse = np.where(none, 0.0, 1.0) / np.where(none, 1.0, length)
        direction = [a * inverse for a in row]
        F[i][i] = length
        for j in range(i + 1, n):
            share = dot(rows[j], direction)
            rows[j] = [a - share * b for a, b in zip(rows[j], direction, strict=True)]
            F[j][i] = share
    return F


def product(A: Matrix, B: Matrix) -> list[list[Any]]:
    """Computes A B."""
    n = len(A)
    columns = len(B[0]) if B else 0
    graph = _large(A, n * len(B) * columns)
    if graph is not None:
        sizes = (n, len(B), columns)
        given = [a for row in [*A, *B] for a in row]
        found = graph.block("product", sizes, given, n * columns)
        return [found[i * columns : (i + 1) * columns] for i in range(n)]
    across = [*zip(*B, strict=True)]
    return [[dot(row, column) for column in across] for row in A]


def gram(F: Matrix) -> list[list[Any]]:
    """Computes F F' of a triangular F."""
    n = len(F)
    if _large(F, n**3) is not None:
        return product(F, [*zip(*F, strict=True)])
    C: list[list[Any]] = [[0.0] * n for _ in F]
    for i in range(n):
        for j in range(i + 1):
            C[i][j] = C[j][i] = dot(F[i][: j + 1], F[j][: j + 1])
    return C


def _large(A: Matrix, products: int) -> Graph | None:
    """Returns the graph of a matrix of expressions whose operation is large."""
    if products <= _LARGE:
        return None
    entries = (a for row in A for a in row if isinstance(a, Expression))
    first = next(entries, None)
    return None if first is None else first.graph


def dot(a: Sequence[Any], b: Sequence[Any], start: Any = 0.0) -> Any:
    return reduce(add, map(mul, a, b), start)
