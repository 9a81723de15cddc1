"""Reads formulas: numbers, names, + - * / ** ( ), elementary functions, comparisons and `A if C
else B`.

Python's grammar reads the text, and nothing of it is executed: it becomes a tree, which is
evaluated on numbers, arrays or recorded expressions.
"""

from __future__ import annotations

import ast
import functools
import itertools
import math
import operator
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.engine import trace


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Returns a where the condition is not 0, b elsewhere."""
    if isinstance(condition, float):
        return a if condition else b
    return np.where(condition, a, b)


def _real(a: Any) -> Any:
    """Returns the real part of a complex step; expressions are real."""
    return getattr(a, "real", a)


def _angle(y: Any, x: Any) -> Any:
    """Computes arctan2, which NumPy lacks for complex numbers, with its slope by a complex step."""
    b = _real(y)
    a = _real(x)
    angle = np.arctan2(b, a)
    if isinstance(angle, trace.Expression) or not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return angle
    # d angle = (a db - b da) / (a^2 + b^2).
    turned = a * np.imag(y) - b * np.imag(x)
    return angle + 1j * turned / (a * a + b * b)


FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    **trace.FUNCTIONS,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "ln": np.log,
    "log10": lambda a: np.log(a) / math.log(10.0),
    "floor": lambda a: np.floor(_real(a)),
    "sign": lambda a: np.sign(_real(a)),
    # NumPy's drops the imaginary part of a complex step.
    "abs": lambda a: choose(np.less(a, 0.0) * 1.0, -a, a),
}
"""Functions of one argument."""
SEVERAL: dict[str, Callable[[Any, Any], Any]] = {
    "min": np.minimum,
    "max": np.maximum,
    "hypot": lambda a, b: np.sqrt(a * a + b * b),
}
"""Functions of two arguments or more."""
PAIRS: dict[str, Callable[[Any, Any], Any]] = {
    "arctan2": _angle,
    "atan2": _angle,
    "mod": lambda a, b: a - b * np.floor(_real(a / b)),
}
"""Functions of two arguments; the remainder of `mod` has the sign of what divides."""
_FROM = "at or above"
"""A comparison of no formula, of which no note says that it never switches."""
TABLES = {"interp": "x and a table x1, y1, x2, y2, ... of rising x1, x2, ..."}
"""Functions of a table, which they write out in conditionals."""
_CALLED = (*FUNCTIONS, *SEVERAL, *PAIRS, *TABLES)
COMPARISONS = {
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "==": np.equal,
    "!=": np.not_equal,
}
"""They are 1 where they hold and 0 elsewhere."""
CONSTANTS = {"pi": math.pi}
_SIGNS = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.Pow: "**",
    ast.And: "and",
    ast.Or: "or",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
}
_MOST_IN_A_ROW = 400
"""Operations that build on one another, as in a sum of so many terms."""
_MOST_OPERATIONS = 10_000
"""Numbers, names and operations of a formula, where the middle of 0 < a < 1 counts twice."""
_IN_PYTHON = "write the model in Python (`ipe-bench new measurement`)"
_ALPHABET = re.compile(r"[\w\s.,+\-*/^()<>=!]*", re.ASCII)
_NAME = re.compile(r"(?<![\w.])(?!(?:if|else|and|or|not)\b)(?=[A-Za-z_])")
"""The place before a name."""
_NUMBER = re.compile(r"(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)

Tree = tuple[Any, ...]


@dataclass(frozen=True)
class Arithmetic:
    """Holds a formula that was read: `names` are its variables, in order of appearance."""

    text: str
    tree: Tree
    names: tuple[str, ...]
    where: str = ""
    """Config key of the formula."""

    def __call__(self, values: Mapping[str, Any]) -> Any:
        """Evaluates the formula at the `values` of its names: numbers, arrays, or expressions to be
        recorded."""
        return evaluate(self.tree, values)


def parse(text: str, where: str) -> Arithmetic:
    """Reads a formula; `where` is the config key, for messages.

    ** (or ^) binds from the right and before a minus in front: -x**2 is -(x**2). Comparisons,
    `and`, `or`, `not` and `A if C else B` are those of Python, also in a row: 2 <= t < 5. The
    branch that a conditional does not take need not have a value.

    Raises:
        UserError: the text is not a formula of this language, by the place where it ceases to be
            one.
    """
    # Names get a letter in front, so that a parameter may be called lambda.
    source = _NAME.sub("_", " ".join(text.split()).replace("^", "**"))
    try:
        if not _ALPHABET.fullmatch(text):
            if "[" in text:
                raise SyntaxError(
                    "a list has no meaning; a table is interp(x, x1, y1, x2, y2, ...)"
                )
            raise SyntaxError("a character has no meaning here")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = _tree(ast.parse(source, mode="eval").body, source)
        size, height = _extent(tree, {})
        if height > _MOST_IN_A_ROW:
            raise RecursionError
    except (RecursionError, MemoryError):
        remedy = f"group terms by parentheses, or {_IN_PYTHON}"
        raise UserError(
            f"{where}: has more than {_MOST_IN_A_ROW} operations one after another; {remedy}"
        ) from None
    except SyntaxError as error:
        rest = _as_written(source[(error.offset or 1) - 1 :].strip())
        place = f"at '{rest[:20]}'" if rest else "at its end"
        known = "numbers, names, + - * / ** ( ), comparisons and `A if C else B` are understood"
        reason = error.msg.partition(". ")[0]
        raise UserError(
            f"{where}: {text[:60]!r} is not a formula {place}: {reason}; {known}"
        ) from None
    except NameError as error:
        meant = unknown(str(error.name), _CALLED, "function")
        raise UserError(f"{where}: {error.name}(...): {meant}") from None
    if size > _MOST_OPERATIONS:
        raise UserError(
            f"{where}: has more than {_MOST_OPERATIONS} numbers, names and operations; {_IN_PYTHON}"
        )
    names = dict.fromkeys(part[1] for part in parts(tree) if part[0] == "name")
    variables = tuple(name for name in names if name not in CONSTANTS)
    return Arithmetic(text, tree, variables, where)


def _as_written(source: str) -> str:
    """Takes the letter away that names got in front."""
    return re.sub(r"\b_", "", source)


def _tree(node: ast.expr, source: str) -> Tree:
    """Builds the tree of a part of the text.

    Raises:
        SyntaxError: the part is Python and no formula.
        NameError: a function is not known.
    """
    reason = "this is Python, and not of this language"
    match node:
        case ast.Constant():
            number = source[node.col_offset : node.end_col_offset]
            if _NUMBER.fullmatch(number):
                return ("number", float(number))
        case ast.Name(name):
            return ("name", name[1:])
        case ast.UnaryOp(ast.USub(), operand):
            return ("negative", _tree(operand, source))
        case ast.UnaryOp(ast.UAdd(), operand):
            return _tree(operand, source)
        case ast.UnaryOp(ast.Not(), operand):
            return ("if", _tree(operand, source), ("number", 0.0), ("number", 1.0))
        case ast.BinOp(left, sign, right) if type(sign) in _SIGNS:
            return (_SIGNS[type(sign)], _tree(left, source), _tree(right, source))
        case ast.IfExp(condition, a, b):
            return ("if", _tree(condition, source), _tree(a, source), _tree(b, source))
        case ast.BoolOp(sign, values):
            return _in_a_row(_SIGNS[type(sign)], [_tree(value, source) for value in values])
        case ast.Compare(left, signs, others) if all(type(sign) in _SIGNS for sign in signs):
            operands = [left, *others]
            trees = [_tree(one, source) for one in operands]
            texts = [_as_written(source[o.col_offset : o.end_col_offset]) for o in operands]
            return _compared([_SIGNS[type(sign)] for sign in signs], trees, texts)
        case ast.Call(ast.Name(name), arguments, []):
            function = name[1:]
            if function not in _CALLED:
                raise NameError(name=function)
            called = _called(function, [_tree(argument, source) for argument in arguments])
            if called:
                return called
            reason = f"{function} takes {_number_of_arguments(function)}"
    raise SyntaxError(reason, (None, 1, node.col_offset + 1, source))


def _compared(signs: Sequence[str], trees: Sequence[Tree], texts: Sequence[str]) -> Tree:
    """Builds comparisons in a row, each with its text: a < b < c is a < b and b < c."""
    compared = []
    for k, sign in enumerate(signs):
        text = f"{texts[k]} {sign} {texts[k + 1]}"
        compared.append((sign, trees[k], trees[k + 1], text))
    return _in_a_row("and", compared)


def _called(function: str, arguments: Sequence[Tree]) -> Tree:
    """Builds the call of a function; empty if it takes another number of arguments."""
    number = len(arguments)
    if function == "interp":
        places = [tree[1] for tree in arguments[1::2] if tree[0] == "number"]
        rises = all(a < b for a, b in itertools.pairwise(places))
        return _interpolated(*arguments) if number > 4 and number % 2 and rises else ()
    if (function in SEVERAL and number > 1) or (function in PAIRS and number == 2):
        return _in_a_row(function, arguments)
    if function in FUNCTIONS and number == 1:
        return (function, *arguments)
    return ()


def _interpolated(x: Tree, *table: Tree) -> Tree:
    """Builds the value at x of straight lines between the points of a table, level beyond its
    ends."""
    points = list(zip(table[::2], table[1::2], strict=True))
    found = points[0][1]
    for (x1, y1), (x2, y2) in itertools.pairwise(points):
        slope = ("/", ("-", y2, y1), ("-", x2, x1))
        line = ("+", y1, ("*", slope, ("-", x, x1)))
        found = ("if", (_FROM, x, x1), line, found)
    last_x, last_y = points[-1]
    return ("if", (_FROM, x, last_x), last_y, found)


def _number_of_arguments(function: str) -> str:
    if function in TABLES:
        return TABLES[function]
    if function in FUNCTIONS:
        return "one argument"
    return "two arguments or more" if function in SEVERAL else "two arguments"


def _in_a_row(operation: str, trees: Iterable[Tree]) -> Tree:
    """Joins operands by an operation from the left."""
    return functools.reduce(lambda left, right: (operation, left, right), trees)


def parts(tree: Tree) -> list[Tree]:
    """Lists the tree and all trees in it, in order of appearance."""
    found = []
    waiting = [tree]
    while waiting:
        part = waiting.pop()
        found.append(part)
        waiting.extend(inner for inner in reversed(part) if isinstance(inner, tuple))
    return found


def never_switching(formulas: Iterable[Arithmetic], values: Mapping[str, Any]) -> list[str]:
    """Words each comparison in some formulas that holds for all readings, or for none, at these
    values."""
    where: dict[Tree, str] = {}
    for formula in formulas:
        comparisons = [part for part in parts(formula.tree) if part[0] in COMPARISONS]
        where.update(dict.fromkeys(comparisons, formula.where))
    words = []
    for comparison, key in where.items():
        held = np.asarray(evaluate(comparison, values), dtype=bool)
        if held.all() or not held.any():
            often = "every" if held.all() else "no"
            words.append(
                f"measurement.{key}: {comparison[3]} holds at {often} reading,"
                " so these readings do not test the other branch"
            )
    return words


def _extent(tree: Tree, known: dict[int, tuple[int, int]]) -> tuple[int, int]:
    """Computes the size of a tree, and the most operations that build on one another; a shared
    operand counts once."""
    if id(tree) not in known:
        size = 1
        height = 1
        for part in tree:
            if isinstance(part, tuple):
                inner, below = _extent(part, known)
                size += inner
                height = max(height, below + 1)
        known[id(tree)] = size, height
    return known[id(tree)]


_BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "**": operator.pow,
    "and": lambda a, b: choose(a, b, a),
    "or": lambda a, b: choose(a, a, b),
    **SEVERAL,
    **PAIRS,
    _FROM: lambda a, b: np.greater_equal(a, b) * 1.0,
    **{sign: lambda a, b, holds=holds: holds(a, b) * 1.0 for sign, holds in COMPARISONS.items()},
}


def evaluate(tree: Tree, values: Mapping[str, Any]) -> Any:
    """Evaluates a tree at the `values` of its names."""
    operation, first, *others = tree
    if operation == "number":
        return first
    if operation == "name":
        return values[first] if first in values else CONSTANTS[first]
    value = evaluate(first, values)
    if operation == "if":
        if isinstance(value, float):  # the other branch may have no value
            return evaluate(others[0] if value else others[1], values)
        return np.where(value, evaluate(others[0], values), evaluate(others[1], values))
    if operation in _BINARY:
        return _BINARY[operation](value, evaluate(others[0], values))
    if operation == "negative":
        return -value
    return FUNCTIONS[operation](value)
