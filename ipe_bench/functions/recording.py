"""Records functions of NumPy exactly, or refuses them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.trace import Expression, Program, RowPrograms, in_order, substitute
from ipe_bench.functions.unknowns import (
    ExactGraph,
    Refused,
    Unknown,
    is_unknown,
    objects,
    unknowns,
)

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
    constants: tuple[float, ...]
    ties: Sequence[Expression]
    """Equalities that the outputs depend on."""


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
    needed = {e.order for e in in_order(y)}
    distinct = {tie.order: tie for tie in graph.ties if tie.order in needed}
    program = Program.of([*y, *distinct.values()], x)
    constants = tuple(step[1] for step in program.operations if step[0] == "constant")
    form = tuple(step[:1] if step[0] == "constant" else step for step in program.operations)
    return Written(y, x, (*form, program.outputs), constants, [*distinct.values()])


def compiled_rows(one: Written) -> tuple[RowFunction, RowFunction | None]:
    """Returns a recorded function of x and of its constants, so that other values of these need no
    other machine code; and its ties, None if it has none."""
    graph: Any = one.x[0].graph
    c = graph.inputs("c", len(one.constants))
    numbers: Mapping[Expression, Expression] = {
        graph.constant(value): number for value, number in zip(one.constants, c, strict=True)
    }
    graph.exact = True
    y = substitute(one.y, numbers)
    ties = substitute(one.ties, numbers)
    graph.exact = False
    function = RowFunction(RowPrograms.of(y, one.x, c))
    return function, RowFunction(RowPrograms.of(ties, one.x, c)) if ties else None
