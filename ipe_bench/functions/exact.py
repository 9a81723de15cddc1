"""NumPy's functions of single numbers as operations of a graph, each exactly as NumPy does it.

A truth value is a number, 1 or 0. What a graph of models may simplify, such as 0 x to 0, is left
here: x may be infinite, and then NumPy finds no number.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from ipe_bench.engine.trace import COMPOSED, FUNCTIONS, Expression, Graph, computed

HUGE = sys.float_info.max
"""The largest finite number."""


class Refused(BaseException):
    """Says that an unknown met something that needs its number."""


class ExactGraph(Graph):
    """Holds the operations of a function as NumPy does them: 0 x is 0 only where x is finite."""

    def __init__(self, most: float = math.inf) -> None:
        super().__init__(most)
        self.exact = True
        """Whether operations stay as they are; tangents may be simplified."""
        self.refused = ""
        """Why the function cannot be recorded."""

    def apply(self, operation: str, *operands: Any) -> Expression:
        if not self.exact:
            return super().apply(operation, *operands)
        args = self._expressions(operands)
        constant = [a.operation == "constant" for a in args]
        if not any(constant):
            return self._node(operation, *args)
        values = [a.value for a in args]
        if all(constant):
            with np.errstate(all="ignore"):
                value = computed(operation, *map(np.float64, values))
                return self.constant(float(value))
        match operation, values:
            case ("pow", [_, 0.0] | [1.0, _]):
                return self.constant(1.0)
            case ("mul" | "div" | "pow", [_, 1.0]) | ("add" | "sub", [_, 0.0]):
                return args[0]
            case ("mul", [1.0, _]) | ("add", [0.0, _]):
                return args[1]
            case ("pow", [_, 2.0]):
                return self._node("mul", args[0], args[0])
            case ("pow", [_, 0.5]):
                return self._node("sqrt", args[0])
            case ("where", [float(condition), _, _]):
                return args[1] if condition else args[2]
        return self._node(operation, *args)

    def refuse(self, what: str) -> Refused:
        """Returns what is to be raised, and keeps the first reason."""
        self.refused = self.refused or what
        return Refused(what)


SAME = {
    "true_divide": "divide",
    "bitwise_and": "logical_and",
    "bitwise_or": "logical_or",
    "bitwise_xor": "not_equal",
    "logical_xor": "not_equal",
    "logical_not": "invert",
    "fabs": "absolute",
    "mod": "remainder",
    "conjugate": "positive",
    "deg2rad": "radians",
    "rad2deg": "degrees",
    "float_power": "power",
}
"""Other names of NumPy's for functions in `OPERATIONS`."""
TRUTHS = {
    *("less", "less_equal", "greater", "greater_equal", "equal", "not_equal"),
    *("logical_and", "logical_or", "invert", "isnan", "isfinite", "isinf"),
}
"""Functions whose results are truth values."""


def _not(apply: Any, a: Any) -> Any:
    return apply("sub", 1.0, a)


def _or(apply: Any, a: Any, b: Any) -> Any:
    return _not(apply, apply("mul", _not(apply, a), _not(apply, b)))


def _finite(apply: Any, a: Any) -> Any:
    below = apply("less_equal", a, HUGE)
    above = apply("less_equal", -HUGE, a)
    return apply("mul", below, above)


def _infinite(apply: Any, a: Any) -> Any:
    number = apply("less_equal", a, a)
    return apply("mul", number, _not(apply, _finite(apply, a)))


def _ignoring(name: str) -> Any:
    """Returns fmin or fmax: of two, the one that is a number."""

    def chosen(apply: Any, a: Any, b: Any) -> Any:
        b_is_number = apply("less_equal", b, b)
        of_both = COMPOSED[name](apply, a, b)
        found = apply("where", b_is_number, of_both, a)
        return apply("where", apply("less_equal", a, a), found, b)

    return chosen


def _clipped(apply: Any, a: Any, low: Any, high: Any) -> Any:
    return COMPOSED["minimum"](apply, COMPOSED["maximum"](apply, a, low), high)


def _plainly(name: str) -> Any:
    return lambda apply, *given: apply(name, *given)


OPERATIONS: dict[str, Callable[..., Any]] = {
    **COMPOSED,
    **{
        name: _plainly(name)
        for name in (
            *FUNCTIONS,
            *("less", "less_equal", "floor", "arctan2", "where", "remainder"),
        )
    },
    "add": _plainly("add"),
    "subtract": _plainly("sub"),
    "multiply": _plainly("mul"),
    "divide": _plainly("div"),
    "power": _plainly("pow"),
    "negative": _plainly("neg"),
    "positive": lambda apply, a: a,
    "logical_and": _plainly("mul"),
    "logical_or": _or,
    "invert": _not,
    "isnan": lambda apply, a: _not(apply, apply("less_equal", a, a)),
    "isfinite": _finite,
    "isinf": _infinite,
    "fmin": _ignoring("minimum"),
    "fmax": _ignoring("maximum"),
    "clip": _clipped,
}
"""What is recorded of NumPy, in operations of a graph."""
