"""Records functions of NumPy exactly, or refuses them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.trace import Expression, RowPrograms, in_order, substitute
from ipe_bench.functions.exact import ExactGraph, Refused
from ipe_bench.functions.unknowns import Unknown, is_unknown, objects, unknowns

_MOST_OPERATIONS = 20_000
"""Operations of a function, with its tangents, at most: they take ten seconds to compile, once per
machine."""


class NotRecorded(Exception):
    """Says why a function cannot be recorded."""


class Written(NamedTuple):
    """Holds a function as it is recorded."""

    y: Sequence[Expression]
    x: Sequence[Expression]
    form: tuple[Any, ...]
    """Its operations and outputs but for the values of constants."""
    constants: tuple[str, ...]
    """These values, in hexadecimal digits."""
    graph: ExactGraph

    @property
    def numbers(self) -> list[float]:
        return [float.fromhex(value) for value in self.constants]


def written(function: Callable[[Any], Any], n: int) -> Written:
    """Records a function (rows, n) -> (rows, m), by a row of unknowns.

    Raises:
        NotRecorded: it needs a number, or does what is not recorded.
    """
    graph = ExactGraph(_MOST_OPERATIONS)
    x = graph.inputs("x", n)
    row = np.empty((1, n), dtype=object)
    row[0] = [Unknown(one) for one in x]
    try:
        with np.errstate(all="ignore"):
            outputs = objects(function(unknowns(row, graph)))[0]
        y = [one.node if is_unknown(one) else graph.constant(float(one)) for one in outputs]
    except Refused as refused:
        raise NotRecorded(str(refused)) from None
    except Exception as error:  # a function may raise anything where it meets no numbers
        raise NotRecorded(graph.refused or f"{type(error).__name__}: {error}") from None
    if graph.refused:  # and a bare `except` has swallowed it
        raise NotRecorded(graph.refused)
    steps = list(graph.nodes())
    constants = tuple(e.operands[0] for e in steps if e.operation == "constant")
    form = tuple(_step(e) for e in steps)
    return Written(y, x, (form, tuple(e.order for e in y)), constants, graph)


def _step(e: Expression) -> tuple[Any, ...]:
    if e.operation == "constant":
        return ("constant",)
    return (e.operation, *(a.order if isinstance(a, Expression) else a for a in e.operands))


def compiled_rows(one: Written) -> tuple[RowFunction, RowFunction | None]:
    """Returns a recorded function of x and of its constants, so that other values of these need no
    other machine code; and its ties, None if it has none."""
    graph = one.graph
    needed = set(in_order(one.y))
    distinct = dict.fromkeys(tie for tie in graph.ties if tie in needed)
    c = graph.inputs("c", len(one.constants))
    given = (e for e in graph.nodes() if e.operation == "constant")
    numbers = dict(zip(given, c, strict=True))
    graph.exact = True
    y = substitute(one.y, numbers)
    ties = substitute([*distinct], numbers)
    graph.exact = False
    function = RowFunction(RowPrograms.of(y, one.x, c))
    return function, RowFunction(RowPrograms.of(ties, one.x, c)) if ties else None
