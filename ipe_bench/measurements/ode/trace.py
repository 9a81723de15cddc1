"""Records plain arithmetic as an expression graph, and differentiates it.

A right-hand side written once in ordinary Python arithmetic is called with `Expression` objects instead of numbers.
What comes back knows every operation, so it can be written out as straight-line source (`emit`) or differentiated
exactly in forward mode (`tangent`). Turning source into machine code is left to `kernel`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

Operand: TypeAlias = "Expression | float"

_FUNCTIONS = ("sin", "cos", "tan", "arctan", "exp", "log", "sqrt", "sinh", "cosh", "tanh")
_IN_MATH = {"arctan": "atan"}
_BINARY = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_UFUNCS = {"add": "add", "subtract": "sub", "multiply": "mul", "divide": "div", "true_divide": "div", "power": "pow"}


class Graph:
    """All expressions of one recording; equal expressions are the same object, so nothing is computed twice."""

    def __init__(self) -> None:
        self._known: dict[tuple[Any, ...], Expression] = {}

    def input(self, name: str) -> Expression:
        """The named quantity, to be given when the emitted source runs."""
        return self._node("input", name)

    def inputs(self, prefix: str, count: int) -> tuple[Expression, ...]:
        """`count` inputs named prefix0, prefix1, ..."""
        return tuple(self.input(f"{prefix}{i}") for i in range(count))

    def constant(self, value: float) -> Expression:
        return self._node("constant", float(value).hex())

    def _node(self, operation: str, *operands: Any) -> Expression:
        key = (operation, *(id(a) if isinstance(a, Expression) else a for a in operands))
        if key not in self._known:
            self._known[key] = Expression(self, operation, operands, len(self._known))
        return self._known[key]

    def apply(self, operation: str, *operands: Any) -> Expression:
        """The expression `operation(operands)`, with constants folded and trivial operations dropped."""
        args = [a if isinstance(a, Expression) else self.constant(a) for a in operands]
        values = [a.value for a in args]
        if all(v is not None for v in values):
            return self.constant(_evaluate(operation, [v for v in values if v is not None]))
        simpler = self._simplify(operation, args, values)
        return simpler if simpler is not None else self._node(operation, *args)

    def _simplify(self, operation: str, args: list[Expression], values: list[float | None]) -> Expression | None:
        match operation, values:
            case ("add", [0.0, _]) | ("mul", [1.0, _]):
                return args[1]
            case ("add" | "sub", [_, 0.0]) | ("mul" | "div" | "pow", [_, 1.0]):
                return args[0]
            case ("mul", [0.0, _] | [_, 0.0]) | ("div", [0.0, _]):
                return self.constant(0.0)
            case ("sub", [0.0, _]):
                return self.apply("neg", args[1])
            case ("mul", [-1.0, _]):
                return self.apply("neg", args[1])
            case ("pow", [_, 2.0]):
                return self.apply("mul", args[0], args[0])
            case ("pow", [_, 0.5]):
                return self.apply("sqrt", args[0])
            case ("neg", _) if args[0].operation == "neg":
                return args[0].operands[0]
        return None


class Expression:
    """A quantity that is not known yet: supports + - * / **, and NumPy's elementary functions."""

    __slots__ = ("graph", "operands", "operation", "order")

    def __init__(self, graph: Graph, operation: str, operands: tuple[Any, ...], order: int) -> None:
        self.graph = graph
        self.operation = operation
        self.operands = operands
        self.order = order

    @property
    def value(self) -> float | None:
        """The number this is, where it is a constant."""
        return float.fromhex(self.operands[0]) if self.operation == "constant" else None

    def __add__(self, other: Operand) -> Expression:
        return self.graph.apply("add", self, other)

    def __radd__(self, other: Operand) -> Expression:
        return self.graph.apply("add", other, self)

    def __sub__(self, other: Operand) -> Expression:
        return self.graph.apply("sub", self, other)

    def __rsub__(self, other: Operand) -> Expression:
        return self.graph.apply("sub", other, self)

    def __mul__(self, other: Operand) -> Expression:
        return self.graph.apply("mul", self, other)

    def __rmul__(self, other: Operand) -> Expression:
        return self.graph.apply("mul", other, self)

    def __truediv__(self, other: Operand) -> Expression:
        return self.graph.apply("div", self, other)

    def __rtruediv__(self, other: Operand) -> Expression:
        return self.graph.apply("div", other, self)

    def __pow__(self, exponent: Operand) -> Expression:
        return self.graph.apply("pow", self, exponent)

    def __rpow__(self, base: Operand) -> Expression:
        return self.graph.apply("pow", base, self)

    def __neg__(self) -> Expression:
        return self.graph.apply("neg", self)

    def __pos__(self) -> Expression:
        return self

    def __bool__(self) -> bool:
        raise TypeError("a recorded expression has no truth value: write the model without if, min, max or comparisons")

    __lt__ = __le__ = __gt__ = __ge__ = lambda self, other: bool(self)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__" or kwargs:
            return NotImplemented
        if ufunc.__name__ == "negative":
            return -self
        name = _UFUNCS.get(ufunc.__name__, ufunc.__name__)
        if name not in _BINARY and name not in _FUNCTIONS and name != "pow":
            raise TypeError(f"np.{ufunc.__name__} cannot be recorded; use + - * / ** and {', '.join(_FUNCTIONS)}")
        return self.graph.apply(name, *inputs)

    def __getattr__(self, name: str) -> Any:
        # NumPy calls the method `sin` of each element when np.sin meets an array of objects.
        if name in _FUNCTIONS:
            return lambda: self.graph.apply(name, self)
        raise AttributeError(name)


def _evaluate(operation: str, values: Sequence[float]) -> float:
    match operation:
        case "add":
            return values[0] + values[1]
        case "sub":
            return values[0] - values[1]
        case "mul":
            return values[0] * values[1]
        case "div":
            return values[0] / values[1]
        case "pow":
            return values[0] ** values[1]
        case "neg":
            return -values[0]
    return float(getattr(math, _IN_MATH.get(operation, operation))(*values))


def _partials(e: Expression) -> list[Expression]:
    """The derivatives of one operation with respect to its operands."""
    a: Any = e.operands[0]
    b: Any = e.operands[-1]
    one = e.graph.constant(1.0)
    match e.operation:
        case "add":
            return [one, one]
        case "sub":
            return [one, -one]
        case "mul":
            return [b, a]
        case "div":
            return [one / b, -(e / b)]
        case "pow":
            to_exponent = e * np.log(a) if b.value is None else e.graph.constant(0.0)
            return [b * a ** (b - 1.0), to_exponent]
        case "neg":
            return [-one]
        case "sin":
            return [np.cos(a)]
        case "cos":
            return [-np.sin(a)]
        case "tan":
            return [one + e * e]
        case "arctan":
            return [one / (one + a * a)]
        case "exp":
            return [e]
        case "log":
            return [one / a]
        case "sqrt":
            return [0.5 / e]
        case "sinh":
            return [np.cosh(a)]
        case "cosh":
            return [np.sinh(a)]
        case "tanh":
            return [one - e * e]
    raise TypeError(f"no derivative is known for {e.operation}")


def _in_order(outputs: Iterable[Expression]) -> list[Expression]:
    """Every expression that the outputs need, operands before their users."""
    needed: dict[int, Expression] = {}
    stack = list(outputs)
    while stack:
        e = stack.pop()
        if e.order not in needed:
            needed[e.order] = e
            stack.extend(a for a in e.operands if isinstance(a, Expression))
    return [needed[order] for order in sorted(needed)]


def tangent(outputs: Sequence[Expression], direction: Mapping[Expression, Expression]) -> list[Expression]:
    """The derivative of each output along `direction`, which gives the tangent of every input that varies."""
    if not outputs:
        return []
    zero = outputs[0].graph.constant(0.0)
    along: dict[int, Expression] = {}
    for e in _in_order(outputs):
        if e.operation in ("input", "constant"):
            along[e.order] = direction.get(e, zero)
            continue
        moving = [(along[a.order], i) for i, a in enumerate(e.operands) if along[a.order] is not zero]
        if not moving:
            along[e.order] = zero
            continue
        partials = _partials(e)
        total = zero
        for da, i in moving:
            total = total + partials[i] * da
        along[e.order] = total
    return [along[e.order] for e in outputs]


def emit(outputs: Sequence[Expression], indent: str = "    ") -> tuple[str, list[str]]:
    """Straight-line source that computes the outputs, and the term that stands for each of them."""
    terms: dict[int, str] = {}
    lines: list[str] = []
    for e in _in_order(outputs):
        if e.operation == "constant":
            terms[e.order] = repr(e.value)
            continue
        if e.operation == "input":
            terms[e.order] = e.operands[0]
            continue
        args = [terms[a.order] for a in e.operands]
        if e.operation in _BINARY:
            source = f"{args[0]} {_BINARY[e.operation]} {args[1]}"
        elif e.operation == "pow":
            source = f"{args[0]} ** {args[1]}"
        elif e.operation == "neg":
            source = f"-{args[0]}"
        else:
            source = f"math.{_IN_MATH.get(e.operation, e.operation)}({args[0]})"
        terms[e.order] = f"_{e.order}"
        lines.append(f"{indent}_{e.order} = {source}\n")
    return "".join(lines), [terms[e.order] for e in outputs]
