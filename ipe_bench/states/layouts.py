"""Steps whose numbers have names: vectors and matrices that lie one after another in the rows of
`engine.scan`."""

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

Shape: TypeAlias = "int | tuple[tuple[bool, ...], ...]"
"""The length of a vector, or the places of a matrix whose numbers are kept; the others are 0."""


def full(rows: int, columns: int) -> Shape:
    return ((True,) * columns,) * rows


def triangle(n: int) -> Shape:
    return tuple(tuple(j <= i for j in range(n)) for i in range(n))


class Layout:
    """Says where parts of a row of numbers lie."""

    def __init__(self, **shapes: Shape) -> None:
        self.shapes = shapes
        sizes = [one if isinstance(one, int) else sum(map(sum, one)) for one in shapes.values()]
        ends = [*accumulate(sizes, initial=0)]
        self.size = ends[-1]
        self.at = {name: slice(*at) for name, at in zip(shapes, pairwise(ends), strict=True)}

    def __repr__(self) -> str:
        return repr(self.shapes)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))

    def parts(self, numbers: Sequence[Any]) -> dict[str, Any]:
        """Returns the vectors and matrices that these numbers are."""
        return {name: _filled(shape, numbers[self.at[name]]) for name, shape in self.shapes.items()}

    def numbers(self, parts: Mapping[str, Any]) -> list[Any]:
        """Lists the numbers of vectors and matrices."""
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


def _filled(shape: Shape, numbers: Sequence[Any]) -> list[Any]:
    if isinstance(shape, int):
        return list(numbers)
    rest = iter(numbers)
    return [[next(rest) if there else 0.0 for there in places] for places in shape]


def named_step(
    text: Callable[..., Mapping[str, Any]],
    what: Any,
    carried: Layout,
    each: Sequence[Layout],
    shared: Layout,
    shown: Layout,
) -> Step:
    """Returns the step of a text, which takes the named parts of what is carried, of arrays of its
    trial and of its epoch, and gives those that are carried on and shown. It is recorded only if
    its machine code is not kept; `what` tells it from other texts of these layouts."""

    def record() -> Program:
        graph = Graph()
        inputs = []
        parts = {}
        for number, layout in enumerate((carried, *each, shared)):
            unknowns = graph.inputs(f"{number} ", layout.size)
            assert parts.keys().isdisjoint(layout.shapes)
            parts |= layout.parts(unknowns)
            inputs += unknowns
        found = text(**parts)
        outputs = [*carried.numbers(found), *shown.numbers(found)]
        # What is a number, or an input itself, becomes an expression.
        return Program.of([graph.apply("add", a, 0.0) for a in outputs], inputs)

    key = repr((what, carried, each, shared, shown, compiled.digest_of(*_FILES)))
    sizes = (carried.size, tuple(one.size for one in each), shared.size, shown.size)
    return Step(hashlib.sha256(key.encode()).hexdigest(), record, *sizes)


def packed(F: Array) -> Array:
    """Returns the numbers (..., n (n + 1) / 2) of triangular matrices F (..., n, n)."""
    return F[(..., *_places(F.shape[-1]))]


def unpacked(numbers: Array, n: int) -> Array:
    F = np.zeros((*numbers.shape[:-1], n, n))
    F[(..., *_places(n))] = numbers
    return F


@functools.cache
def _places(n: int) -> tuple[Array, Array]:
    return np.tril_indices(n)
