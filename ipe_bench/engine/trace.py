"""Records plain arithmetic as an expression graph, and differentiates it.

A function that is called with an `Expression` in place of every number returns all its operations,
which can be listed as a straight-line program (`Program`) or differentiated exactly in forward mode
(`tangent`).
"""

from __future__ import annotations

import importlib
import math
import operator
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    name: getattr(np, name)
    for name in (
        *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh"),
        *("arcsinh", "arccosh", "arctanh", "exp", "expm1", "log", "log1p", "sqrt", "cbrt"),
    )
}
FUNCTIONS |= {
    name: lambda a, name=name: getattr(importlib.import_module("scipy.special"), name)(a)
    for name in ("erf", "erfc")
}
"""The elementary functions that can be recorded, of numbers, arrays and expressions; log is the
natural logarithm."""
_UFUNCS = {
    "add": "add",
    "subtract": "sub",
    "multiply": "mul",
    "divide": "div",
    "true_divide": "div",
    "power": "pow",
}
_UFUNCS |= {"negative": "neg"} | {
    name: name for name in ("less", "less_equal", "floor", "arctan2", *FUNCTIONS)
}
COMPARING = ("less", "less_equal")
"""Operations that are 1 where they hold and 0 elsewhere."""
FLAT = (*COMPARING, "floor")
"""Operations whose slope is 0 between jumps."""


class Graph:
    """Holds all expressions of one recording; equal expressions are the same object, so each is
    computed once."""

    def __init__(self, most: float = math.inf) -> None:
        """Holds `most` expressions at most; ValueError beyond."""
        self._known: dict[tuple[Any, ...], Expression] = {}
        self._most = most
        self.ties: list[Expression] = []
        """Equalities of unknowns: where one holds, a branch may stand for a single point, such as
        the limit of sin(w) / w at 0, and then has no slope to give."""

    def input(self, name: str) -> Expression:
        """Declares the named quantity, to be given when the emitted source runs."""
        return self._node("input", name)

    def inputs(self, prefix: str, count: int) -> tuple[Expression, ...]:
        """Declares `count` inputs named prefix0, prefix1, ..."""
        return tuple(self.input(f"{prefix}{i}") for i in range(count))

    def nodes(self) -> Iterable[Expression]:
        """Returns all expressions, in the order in which they were made."""
        return self._known.values()

    def constant(self, value: float) -> Expression:
        return self._node("constant", float(value).hex())

    def _node(self, operation: str, *operands: Any) -> Expression:
        # Equal operations on the same operands are one node (hash consing).
        key = (operation, *(id(a) if isinstance(a, Expression) else a for a in operands))
        if key not in self._known:
            if len(self._known) >= self._most:
                raise ValueError(f"it has more than {self._most} operations")
            self._known[key] = Expression(self, operation, operands, len(self._known))
        return self._known[key]

    def block(
        self, name: str, sizes: Iterable[Any], operands: Sequence[Any], count: int
    ) -> list[Expression]:
        """Applies an operation of many operands and `count` results, which is written as loops."""
        operation = " ".join(map(str, [name, *sizes]))
        made = self._node(operation, *self._expressions(operands))
        return [self._node(f"part {i}", made) for i in range(count)]

    def _expressions(self, operands: Iterable[Any]) -> list[Expression]:
        """Returns operands with constants in place of numbers."""
        return [a if isinstance(a, Expression) else self.constant(a) for a in operands]

    def apply(self, operation: str, *operands: Any) -> Expression:
        """Applies an operation to operands, with constants folded and trivial operations
        dropped."""
        args = self._expressions(operands)
        values = [a.value for a in args]
        # An operation on constants is a constant.
        if all(v is not None for v in values):
            return self.constant(float(_NUMBERS[operation](*values)))
        # x + 0, 1 x, x / 1, x^1, 0 x and the like need no operation; x - (-y) is x + y.
        match operation, values:
            case ("add", [0.0, _]) | ("mul", [1.0, _]):
                return args[1]
            case ("add" | "sub", [_, 0.0]) | ("mul" | "div" | "pow", [_, 1.0]):
                return args[0]
            case ("mul", [0.0, _] | [_, 0.0]) | ("div", [0.0, _]):
                return self.constant(0.0)
            case ("sub", [0.0, _]) | ("mul", [-1.0, _]):
                return self.apply("neg", args[1])
            case ("pow", [_, 0.0]):
                return self.constant(1.0)
            case ("pow", [_, 2.0]):
                return self.apply("mul", args[0], args[0])
            case ("pow", [_, 0.5]):
                return self.apply("sqrt", args[0])
            case ("neg", _) if args[0].operation == "neg":
                return args[0].operands[0]
            case ("add", _) if args[1].operation == "neg":
                return self.apply("sub", args[0], args[1].operands[0])
            case ("add", _) if args[0].operation == "neg":
                return self.apply("sub", args[1], args[0].operands[0])
            case ("sub", _) if args[1].operation == "neg":
                return self.apply("add", args[0], args[1].operands[0])
            case ("where", [float(condition), _, _]):
                return args[1] if condition else args[2]
            case ("where", [None, 1.0, 0.0]) if args[0].operation in COMPARING:
                return args[0]
            case ("where", _) if args[1] is args[2]:
                return args[1]
        return self._node(operation, *args)


def _operator(name: str, *, reflected: bool = False) -> Any:
    if reflected:
        return lambda self, other: self.graph.apply(name, other, self)
    return lambda self, other: self.graph.apply(name, self, other)


@dataclass(eq=False, repr=False, slots=True)
class Expression:
    """Represents an unknown quantity: supports + - * / **, NumPy's elementary functions,
    comparisons and np.where."""

    graph: Graph
    operation: str
    operands: tuple[Any, ...]
    order: int

    @property
    def value(self) -> float | None:
        """The number this is, where it is a constant."""
        return float.fromhex(self.operands[0]) if self.operation == "constant" else None

    __add__, __radd__ = _operator("add"), _operator("add", reflected=True)
    __sub__, __rsub__ = _operator("sub"), _operator("sub", reflected=True)
    __mul__, __rmul__ = _operator("mul"), _operator("mul", reflected=True)
    __truediv__, __rtruediv__ = _operator("div"), _operator("div", reflected=True)
    __pow__, __rpow__ = _operator("pow"), _operator("pow", reflected=True)

    def __neg__(self) -> Expression:
        return self.graph.apply("neg", self)

    def __pos__(self) -> Expression:
        return self

    def __bool__(self) -> bool:
        remedy = "np.where, np.minimum and np.maximum are recorded"
        raise TypeError(
            "a recorded expression has no truth value: write the model without if, min and max;"
            f" {remedy}"
        )

    def __eq__(self, other: object) -> Any:
        # Expressions are kept in sets and are keys: among them only the same one is equal.
        if isinstance(other, int | float | np.number):
            return COMPOSED["equal"](self.graph.apply, self, other)
        return self is other

    __hash__ = object.__hash__
    __lt__, __gt__ = _operator("less"), _operator("less", reflected=True)
    __le__, __ge__ = _operator("less_equal"), _operator("less_equal", reflected=True)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__" or kwargs:
            return NotImplemented
        if ufunc.__name__ in COMPOSED:
            return COMPOSED[ufunc.__name__](self.graph.apply, *inputs)
        if ufunc.__name__ not in _UFUNCS:
            known = ", ".join((*FUNCTIONS, "arctan2", "floor", *COMPOSED))
            raise TypeError(
                f"np.{ufunc.__name__} cannot be recorded; use + - * / **, np.where and {known}"
            )
        return self.graph.apply(_UFUNCS[ufunc.__name__], *inputs)

    def __array_function__(
        self, function: Any, types: Any, args: tuple[Any, ...], kwargs: Any
    ) -> Any:
        if function is not np.where or len(args) != 3:
            raise TypeError(
                f"np.{function.__name__} cannot be recorded; apply it to numbers, or write it out"
            )
        return self.graph.apply("where", *args)

    def __getattr__(self, name: str) -> Any:
        # NumPy calls the method `sin` of each element when np.sin meets an array of objects.
        if name in FUNCTIONS:
            return lambda: self.graph.apply(name, self)
        raise AttributeError(name)


COMPOSED: dict[str, Callable[..., Any]] = {
    "greater": lambda apply, a, b: apply("less", b, a),
    "greater_equal": lambda apply, a, b: apply("less_equal", b, a),
    "equal": lambda apply, a, b: _tie(apply, a, b),
    "not_equal": lambda apply, a, b: apply("sub", 1.0, _tie(apply, a, b)),
    "square": lambda apply, a: apply("mul", a, a),
    "reciprocal": lambda apply, a: apply("div", 1.0, a),
    "ceil": lambda apply, a: apply("neg", apply("floor", apply("neg", a))),
    "degrees": lambda apply, a: apply("mul", a, 180.0 / math.pi),
    "radians": lambda apply, a: apply("mul", a, math.pi / 180.0),
    "log10": lambda apply, a: apply("div", apply("log", a), math.log(10.0)),
    "log2": lambda apply, a: apply("div", apply("log", a), math.log(2.0)),
    "logaddexp": lambda apply, a, b: apply(
        "add",
        COMPOSED["maximum"](apply, a, b),
        apply("log1p", apply("exp", apply("neg", COMPOSED["absolute"](apply, apply("sub", a, b))))),
    ),
    "exp2": lambda apply, a: apply("pow", 2.0, a),
    "heaviside": lambda apply, a, at_0: apply(
        "where",
        apply("less_equal", a, a),
        apply(
            "where", apply("less", a, 0.0), 0.0, apply("where", apply("less", 0.0, a), 1.0, at_0)
        ),
        a,
    ),
    "absolute": lambda apply, a: apply("where", apply("less", a, 0.0), apply("neg", a), a),
    "sign": lambda apply, a: apply(
        "where",
        apply("less_equal", a, a),
        apply("sub", apply("less", 0.0, a), apply("less", a, 0.0)),
        a,
    ),
    "remainder": lambda apply, a, b: apply(
        "sub", a, apply("mul", b, apply("floor", apply("div", a, b)))
    ),
    "hypot": lambda apply, a, b: apply(
        "sqrt", apply("add", apply("mul", a, a), apply("mul", b, b))
    ),
    "minimum": lambda apply, a, b: _first_if(apply, apply("less", a, b), a, b),
    "maximum": lambda apply, a, b: _first_if(apply, apply("less", b, a), a, b),
}
"""NumPy's functions that are made of several operations."""


def _tie(apply: Callable[..., Any], a: Any, b: Any) -> Any:
    """Returns whether a equals b, which the graph remembers."""
    node = apply("mul", apply("less_equal", a, b), apply("less_equal", b, a))
    if a is not b and isinstance(node, Expression) and node.value is None:
        node.graph.ties.append(node)
    return node


def _first_if(apply: Callable[..., Any], condition: Any, a: Any, b: Any) -> Any:
    """Returns a where the condition holds or a is not a number, else b."""
    other = apply("where", apply("less_equal", a, a), b, a)
    return apply("where", condition, a, other)


_OPERATORS: dict[str, Callable[..., Any]] = {
    name: getattr(operator, name) for name in ("add", "sub", "mul", "pow", "neg")
}
_OPERATORS["div"] = operator.truediv
_NUMBERS: dict[str, Callable[..., Any]] = _OPERATORS | {
    "arctan2": math.atan2,
    "floor": math.floor,
    "less": operator.lt,
    "less_equal": operator.le,
    "where": lambda condition, a, b: a if condition else b,
    **{name: getattr(math, name.replace("arc", "a")) for name in FUNCTIONS},
}
_ARRAYS: dict[str, Callable[..., Any]] = _OPERATORS | {
    "less": lambda a, b: np.less(a, b) * 1.0,
    "less_equal": lambda a, b: np.less_equal(a, b) * 1.0,
    "where": lambda condition, a, b: np.where(condition, a, b) * 1.0,
    "arctan2": np.arctan2,
    "floor": np.floor,
    "remainder": np.remainder,
    "fma": lambda a, b, c: a * b + c,
    "fms": lambda a, b, c: a * b - c,
    "fnma": lambda a, b, c: c - a * b,
    **FUNCTIONS,
}
"""The operations of a program, on arrays; products are rounded before they are added."""


def computed(operation: str, *values: Any) -> Any:
    """Applies an operation to numbers as NumPy does."""
    return _ARRAYS[operation](*values)


_PARTIALS: dict[str, Callable[[Any, Any, Any, Any], list[Any]]] = {
    "add": lambda e, one, a, b: [one, one],
    "sub": lambda e, one, a, b: [one, -one],
    "mul": lambda e, one, a, b: [b, a],
    "div": lambda e, one, a, b: [one / b, -(e / b)],
    # d(a^b)/db = a^b log(a), which is 0 where a = 0 and b > 0, and not 0 times infinity.
    "pow": lambda e, one, a, b: [
        b * a ** (b - 1.0),
        e.graph.apply("where", e, e * np.log(a), 0.0) if b.value is None else e.graph.constant(0.0),
    ],
    "neg": lambda e, one, a, _: [-one],
    "tan": lambda e, one, a, _: [one + e * e],
    "sin": lambda e, one, a, _: [np.cos(a)],
    "cos": lambda e, one, a, _: [-np.sin(a)],
    "arctan": lambda e, one, a, _: [one / (one + a * a)],
    "arctan2": lambda e, one, a, b: [b / (a * a + b * b), -(a / (a * a + b * b))],
    "arcsin": lambda e, one, a, _: [one / np.sqrt((one - a) * (one + a))],
    "arccos": lambda e, one, a, _: [-(one / np.sqrt((one - a) * (one + a)))],
    "arcsinh": lambda e, one, a, _: [one / np.sqrt(one + a * a)],
    "arccosh": lambda e, one, a, _: [one / np.sqrt((a - one) * (a + one))],
    "arctanh": lambda e, one, a, _: [one / ((one - a) * (one + a))],
    "remainder": lambda e, one, a, b: [one, -np.floor(a / b)],
    "exp": lambda e, one, a, _: [e],
    "expm1": lambda e, one, a, _: [e + one],
    "log1p": lambda e, one, a, _: [one / (one + a)],
    "cbrt": lambda e, one, a, _: [one / (3.0 * e * e)],
    "log": lambda e, one, a, _: [one / a],
    "sqrt": lambda e, one, a, _: [0.5 / e],
    "sinh": lambda e, one, a, _: [np.cosh(a)],
    "cosh": lambda e, one, a, _: [np.sinh(a)],
    "tanh": lambda e, one, a, _: [one - e * e],
    "erf": lambda e, one, a, _: [2.0 / math.sqrt(math.pi) * np.exp(-(a * a))],
    "erfc": lambda e, one, a, _: [-2.0 / math.sqrt(math.pi) * np.exp(-(a * a))],
}
"""The derivatives of an operation e by its operands, the first a and the last b."""


def operands(e: Expression) -> list[Expression]:
    return [a for a in e.operands if isinstance(a, Expression)]


def in_order(
    outputs: Iterable[Expression],
    stop: Collection[Expression] = (),
    needs: Callable[[Expression], Iterable[Expression]] = operands,
) -> list[Expression]:
    """Lists what the outputs need, operands before their users; what `stop` is computed from is
    left out."""
    # Depth first from the outputs; the order of recording puts operands before their users.
    ends = {e.order for e in stop}
    needed: dict[int, Expression] = {}
    stack = list(outputs)
    while stack:
        e = stack.pop()
        if e.order not in needed:
            needed[e.order] = e
            if e.order not in ends:
                stack.extend(needs(e))
    return [needed[order] for order in sorted(needed)]


def dependent(outputs: Iterable[Expression], inputs: Iterable[Expression]) -> set[Expression]:
    """Selects those among the outputs and what they need that depend on any of the inputs."""
    found = set(inputs)
    # Operands come first, so that one pass finds all.
    for e in in_order(outputs):
        if any(a in found for a in operands(e)):
            found.add(e)
    return found


def border(outputs: Sequence[Expression], varying: Collection[Expression]) -> list[Expression]:
    """Selects what the varying expressions need, or the outputs are, without being varying or a
    number."""
    # The operands of varying operations, and outputs, that do not vary themselves.
    used = [a for e in in_order(outputs) if e in varying for a in operands(e)]
    outside = {e for e in [*used, *outputs] if e not in varying and e.value is None}
    return sorted(outside, key=lambda e: e.order)


def substitute(
    outputs: Sequence[Expression], values: Mapping[Expression, Expression]
) -> list[Expression]:
    """Replaces some inputs or numbers of expressions, and simplifies these."""
    known: dict[Expression, Expression] = {}
    for e in in_order(outputs):
        given = [known[a] for a in operands(e)]
        if e in values:
            known[e] = values[e]
        elif given:
            known[e] = e.graph.apply(e.operation, *given)
        else:
            known[e] = e
    return [known[e] for e in outputs]


def slopes(output: Expression, inputs: Iterable[Expression]) -> list[Expression]:
    """Differentiates the output by each input; of thousands of inputs, each is followed to its own
    users alone."""
    users: defaultdict[Expression, list[Expression]] = defaultdict(list)
    for e in in_order([output]):
        for a in operands(e):
            users[a].append(e)
    one = output.graph.constant(1.0)
    found = []
    for a in inputs:
        affected = in_order([a], needs=users.__getitem__)
        found += tangent([output], {a: one}, affected)
    return found


def tangent(
    outputs: Sequence[Expression],
    direction: Mapping[Expression, Expression],
    varying: Iterable[Expression] | None = None,
) -> list[Expression]:
    """Differentiates each output along `direction`, which gives the tangent of every input that
    varies; `varying` is what depends on these, operands before their users, where it is known."""
    if not outputs:
        return []
    # Forward mode: along[e] is the tangent of e (Griewank and Walther, Evaluating Derivatives,
    # 2008, section 3.1).
    graph = outputs[0].graph
    zero = graph.constant(0.0)
    along: defaultdict[int, Expression] = defaultdict(lambda: zero)
    for e in in_order(outputs) if varying is None else varying:
        if e.operation in ("input", "constant"):
            along[e.order] = direction.get(e, zero)
            continue
        moves = [along[a.order] for a in e.operands]
        if e.operation in FLAT or all(da is zero for da in moves):
            along[e.order] = zero
        elif e.operation == "where":
            # Not by the chain rule: a branch that is not taken may have no slope.
            along[e.order] = graph.apply("where", e.operands[0], *moves[1:])
        else:
            # The chain rule: de = sum_i (de / da_i) da_i over the operands that move.
            one = graph.constant(1.0)
            partials = _PARTIALS[e.operation](e, one, e.operands[0], e.operands[-1])
            total = zero
            for partial, da in zip(partials, moves, strict=True):
                if da is not zero:
                    total = total + partial * da
            along[e.order] = total
    return [along[e.order] for e in outputs]


def separate(
    tangents: Sequence[Expression], moving: Sequence[Expression], direction: Sequence[Expression]
) -> tuple[list[Expression], list[Expression]]:
    """Returns tangents, linear in the tangents of the state (`moving`) and in a `direction` of the
    parameters, with inputs source0, source1, ... in place of what depends on the direction alone;
    and what these stand for.

    The sources are gathered before they are multiplied, so a direction along one parameter has few
    that are not zero.
    """
    # What depends on the tangents of the state, and what depends on the direction alone.
    parts: dict[int, _Parts] = {e.order: (e, None) for e in moving}
    parts |= {e.order: (None, e) for e in direction}
    sources: dict[Expression, Expression] = {}

    def joined(part: _Parts) -> Expression:
        moved, source = part
        if source is not None:
            name = sources.setdefault(source, source.graph.input(f"source{len(sources)}"))
            moved = name if moved is None else moved + name
        assert moved is not None
        return moved

    # From the inputs up, each linear operation splits into its two parts.
    for e in in_order(tangents):
        own = [parts.get(a.order, _NOTHING) for a in operands(e)]
        if e.order not in parts and any(part != _NOTHING for part in own):
            parts[e.order] = _linear(e, own, joined)
    separated = [joined(parts[e.order]) if e.order in parts else e for e in tangents]
    return separated, list(sources)


_Parts: TypeAlias = "tuple[Expression | None, Expression | None]"
_NOTHING: _Parts = (None, None)


def _linear(e: Expression, own: Sequence[_Parts], joined: Callable[[_Parts], Expression]) -> _Parts:
    """Returns the parts of an operation that is linear in the parts of its operands."""
    if e.operation in ("neg", "add", "sub"):
        return _each_part(e, [], own)
    if e.operation == "where":
        return _each_part(e, operands(e)[:1], own[1:])
    # A product or quotient is linear if one operand alone has parts, and divides by none.
    moving = [i for i, part in enumerate(own) if part != _NOTHING]
    place = moving[0]
    divides = e.operation == "div" and place == 1
    if e.operation not in ("mul", "div") or divides or len(moving) > 1:
        raise TypeError(f"a tangent is not linear: {e.operation}")

    def scaled(value: Expression) -> Expression:
        given = operands(e)
        given[place] = value
        return e.graph.apply(e.operation, *given)

    moved, source = own[place]
    if moved is None and source is not None:
        return None, scaled(source)
    return scaled(joined(own[place])), None


def _each_part(e: Expression, held: Sequence[Expression], terms: Sequence[_Parts]) -> _Parts:
    """Applies a sum, or a choice by what is `held`, to either part of its terms."""

    def applied(values: Sequence[Expression | None]) -> Expression | None:
        if all(value is None for value in values):
            return None
        given = [0.0 if value is None else value for value in values]
        return e.graph.apply(e.operation, *held, *given)

    moved = applied([moved for moved, _ in terms])
    source = applied([source for _, source in terms])
    return moved, source


@dataclass(frozen=True)
class Program:
    """Holds straight-line arithmetic on numbered values: first the inputs, then the result of each
    operation.

    An operation is its name and the numbers of its operands, or ("constant", value). A product that
    is added to something and used nowhere else is part of a fused multiply-add, which rounds once:
    ("fma", a, b, c) is a b + c, ("fms", a, b, c) is a b - c, ("fnma", a, b, c) is c - a b. So the
    bits do not hang on what a compiler contracts.
    """

    inputs: int
    operations: tuple[tuple[Any, ...], ...]
    outputs: tuple[int, ...]

    @classmethod
    def of(cls, outputs: Sequence[Expression], inputs: Sequence[Expression]) -> Program:
        """Computes the outputs from the inputs, which may be expressions that are computed
        elsewhere."""
        given = set(inputs)
        needed = [e for e in in_order(outputs, inputs) if e not in given]
        # A product that is used once, in a sum, is computed in the sum (fused multiply-add).
        used = [a for e in needed for a in operands(e)]
        uses = Counter(e.order for e in [*used, *outputs])
        fusions = {e.order: _fusion(e, uses, given) for e in needed}
        inside = {found.product.order for found in fusions.values() if found}
        # The values are numbered: the inputs first, then the results of the operations.
        number = {e.order: i for i, e in enumerate(inputs)}
        operations: list[tuple[Any, ...]] = []
        for e in needed:
            if e.order in inside:
                continue
            if e.operation == "input":
                raise ValueError(f"the program has no input {e.operands[0]}")
            found = fusions[e.order]
            if e.operation == "constant":
                operation = ("constant", e.value)
            elif found:
                taken = [*operands(found.product), found.other]
                operation = (found.name, *(number[a.order] for a in taken))
            else:
                operation = (e.operation, *(number[a.order] for a in operands(e)))
            number[e.order] = len(inputs) + len(operations)
            operations.append(operation)
        results = tuple(number[e.order] for e in outputs)
        return cls(len(inputs), tuple(operations), results)

    @cached_property
    def _released(self) -> tuple[tuple[int, ...], ...]:
        """The values that nothing needs after each operation."""
        # From the last operation back: what none after it needs is released there.
        needed = set(self.outputs)
        released = []
        for name, *numbers in reversed(self.operations):
            last_used = set() if name == "constant" else set(numbers) - needed
            needed |= last_used
            released.append(tuple(last_used))
        return tuple(reversed(released))

    def __call__(self, inputs: Sequence[Any]) -> list[Any]:
        """Computes the outputs by NumPy, entry by entry; a formula on a million rows keeps few
        arrays."""
        values = list(inputs)
        for (name, *numbers), released in zip(self.operations, self._released, strict=True):
            if name == "constant":
                values.append(np.float64(numbers[0]))
            else:
                values.append(_ARRAYS[name](*[values[i] for i in numbers]))
            for i in released:
                values[i] = None
        return [values[i] for i in self.outputs]


@dataclass(frozen=True)
class RowPrograms:
    """Holds a function y(x, c) of rows of numbers as programs: its m values, and its tangents by
    the n numbers x."""

    n: int
    m: int
    values: Program
    """y of x and c, and behind y what the tangents take."""
    tangents: Program
    """The tangent of y, from a direction (n) of x and what `values` have for it."""

    @classmethod
    def of(
        cls, y: Sequence[Expression], x: Sequence[Expression], c: Sequence[Expression]
    ) -> RowPrograms:
        # No formula has a name with a blank in it.
        along = x[0].graph.inputs("along ", len(x))
        # The tangent J along, and what it needs of the values: all that does not depend on `along`.
        moved = tangent(y, dict(zip(x, along, strict=True)))
        saved = border(moved, dependent(moved, along))
        values = Program.of([*y, *saved], [*x, *c])
        tangents = Program.of(moved, [*along, *saved])
        return cls(len(x), len(y), values, tangents)


class _Fused(NamedTuple):
    """Holds the fused operation that a sum is: its name, the product in it, and the other
    operand."""

    name: str
    product: Expression
    other: Expression


def _fusion(
    e: Expression, uses: Mapping[int, int], inputs: Collection[Expression]
) -> _Fused | None:
    """Returns the fused operation that an expression can be, a b + c, a b - c or c - a b, or
    None."""
    if e.operation not in ("add", "sub"):
        return None
    a, b = operands(e)
    for product, other, subtracted in ((a, b, "fms"), (b, a, "fnma")):
        once = uses[product.order] == 1
        if product.operation == "mul" and once and product not in inputs:
            name = "fma" if e.operation == "add" else subtracted
            return _Fused(name, product, other)
    return None
