"""Gives names to the numbers of steps that `engine.scan` runs along epochs.

A step of `engine.scan` takes and gives rows of numbers; here it is written as a *step function* of
named vectors and matrices, in lists. A `Layout` says where each of them lies in a row. The function
is run once on unknowns, which records its program, and only if no machine code is kept from before.
So what is kept is found by a key that tells the step function without running it: its *identity*,
the layouts, and the files in which step functions stand.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.engine import compiled
from ipe_bench.engine.scan import Step
from ipe_bench.engine.trace import Graph, Program

_NAMES = (
    *("information.py", "layouts.py", "linearisation.py", "passes.py", "steps.py", "student.py"),
)
_FILES = [Path(__file__).with_name(name) for name in _NAMES]
"""Files that step functions are written in: machine code from before a change in them is not used
after it."""

Shape: TypeAlias = "int | tuple[tuple[bool, ...], ...]"
"""The length of a vector, or the places of a matrix whose numbers are kept; the others are 0."""


def full(rows: int, columns: int) -> Shape:
    """Returns the shape of a matrix of which every number is kept."""
    return ((True,) * columns,) * rows


def triangle(n: int) -> Shape:
    """Returns the shape of a lower triangular matrix."""
    return tuple(tuple(j <= i for j in range(n)) for i in range(n))


class Layout:
    """Says where parts of a row of numbers lie, one after another."""

    def __init__(self, **shapes: Shape) -> None:
        self.shapes = shapes
        sizes = [_count(shape) for shape in shapes.values()]
        borders = [*accumulate(sizes, initial=0)]
        self.size = borders[-1]
        self.at = {name: slice(*at) for name, at in zip(shapes, pairwise(borders), strict=True)}

    # Names, their order and shapes are all of a layout. So their text decides whether two are
    # equal, and stands for a layout in the key of a step.
    def __repr__(self) -> str:
        return repr(self.shapes)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))

    def parts(self, numbers: Sequence[Any]) -> dict[str, Any]:
        """Returns the vectors and matrices whose numbers these are."""
        return {name: _filled(shape, numbers[self.at[name]]) for name, shape in self.shapes.items()}

    def numbers(self, parts: Mapping[str, Any]) -> list[Any]:
        """Lists the numbers of vectors and matrices, without those of a matrix that are 0."""
        found = []
        for name, shape in self.shapes.items():
            if isinstance(shape, int):
                assert len(parts[name]) == shape, name
                found += parts[name]
                continue
            for row, places in zip(parts[name], shape, strict=True):
                found += [a for a, there in zip(row, places, strict=True) if there]
        return found

    def part(self, rows: Array, name: str, *shape: int) -> Array:
        """Returns a part of rows (..., size), if asked for in a shape (..., *shape)."""
        part = rows[..., self.at[name]]
        return np.ascontiguousarray(part.reshape(*part.shape[:-1], *shape) if shape else part)


def _count(shape: Shape) -> int:
    """Counts the numbers that are kept."""
    return shape if isinstance(shape, int) else sum(map(sum, shape))


def _filled(shape: Shape, numbers: Sequence[Any]) -> list[Any]:
    if isinstance(shape, int):
        return list(numbers)
    rest = iter(numbers)
    return [[next(rest) if there else 0.0 for there in places] for places in shape]


def named_step(
    function: Callable[..., Mapping[str, Any]],
    identity: Any,
    carry: Layout,
    each: Sequence[Layout],
    shared: Layout,
    output: Layout,
) -> Step:
    """Returns the step of a step function. That takes the parts of `carry`, of arrays that have a
    row `each` trial and epoch, and of the row `shared` by all trials of an epoch, and gives the
    parts of the next carry and of the output. The repr of `identity` tells it from other functions
    with these layouts, and must be the same in every process."""

    def record() -> Program:
        graph = Graph()
        inputs = []
        parts = {}
        for number, layout in enumerate((carry, *each, shared)):
            unknowns = graph.inputs(f"{number} ", layout.size)
            assert parts.keys().isdisjoint(layout.shapes)
            parts |= layout.parts(unknowns)
            inputs += unknowns
        found = function(**parts)
        outputs = [*carry.numbers(found), *output.numbers(found)]
        # A program gives expressions: adding 0 makes one of a plain number, and of an input itself.
        return Program.of([graph.apply("add", a, 0.0) for a in outputs], inputs)

    key = repr((identity, carry, each, shared, output, compiled.digest_of(*_FILES)))
    sizes = (carry.size, tuple(one.size for one in each), shared.size, output.size)
    return Step(hashlib.sha256(key.encode()).hexdigest(), record, *sizes)


def packed(F: Array) -> Array:
    """Returns the numbers (..., n (n + 1) / 2) of triangular matrices F (..., n, n)."""
    return F[(..., *_below_diagonal(F.shape[-1]))]


def unpacked(numbers: Array, n: int) -> Array:
    """Returns the triangular matrices F (..., n, n) of their numbers."""
    F = np.zeros((*numbers.shape[:-1], n, n))
    F[(..., *_below_diagonal(n))] = numbers
    return F


@functools.cache
def _below_diagonal(n: int) -> tuple[Array, Array]:
    """Returns rows and columns of a triangle's places, those of the diagonal included."""
    return np.tril_indices(n)
