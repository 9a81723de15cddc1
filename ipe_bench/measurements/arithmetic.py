"""The language of formulas: numbers, names, + - * / ** ( ) and elementary functions, and nothing else.

Text becomes a tree, and a tree is evaluated on whatever numbers, arrays or recorded expressions it is given. Nothing is
handed to Python's own interpreter. What the names stand for is left to the models that are written in this language.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown

FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "arctan": np.arctan,
    "atan": np.arctan,
    "exp": np.exp,
    "log": np.log,
    "ln": np.log,
    "log10": lambda a: np.log(a) / math.log(10.0),
    "sqrt": np.sqrt,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
}
"""Functions of one argument; log is the natural logarithm."""
CONSTANTS = {"pi": math.pi}
_LONGEST = 10_000
_DEEPEST = 50
_MOST_IN_A_ROW = 400
"""Operations that build on one another, as in a sum of so many terms."""
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<sign>\*\*|[-+*/^()]))", re.ASCII
)

Tree = tuple[Any, ...]


@dataclass(frozen=True)
class Arithmetic:
    """A formula that has been read: `names` are what it needs to know, in order of appearance."""

    text: str
    tree: Tree
    names: tuple[str, ...]

    def __call__(self, values: Mapping[str, Any]) -> Any:
        """Its value, where `values` gives that of every name: numbers, arrays, or expressions to be recorded."""
        return _evaluate(self.tree, values)


def require_finite(where: str, value: Any) -> None:
    """Refuses what is not a finite number; `where` is its config key."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UserError(f"{where}={value}: give a finite number")


def require_parameters(where: str, names: Iterable[str], parameters: Iterable[str]) -> None:
    """Refuses a name, under the config key `where`, that is not one of the parameters."""
    for name in names:
        if name not in parameters:
            raise UserError(f"{where}: {name} is not a parameter; these are {', '.join(parameters)}")


def read(text: str, where: str) -> Arithmetic:
    """Reads a formula; `where` is the config key, for messages.

    ** (or ^) binds from the right and before a minus in front: -x**2 is -(x**2).

    Raises:
        UserError: the text is not a formula of this language, by the place where it ceases to be one.
    """
    if len(text) > _LONGEST:
        raise UserError(f"{where}: is longer than {_LONGEST} characters")
    parser = _Parser(text, where)
    tree = parser.sum(0)
    if parser.token is not None:
        parser.refuse("an operator such as + - * / ** is missing")
    if _height(tree) > _MOST_IN_A_ROW:
        remedy = "group terms by parentheses, or write the model in Python (`ipe-bench new measurement`)"
        raise UserError(f"{where}: has more than {_MOST_IN_A_ROW} operations one after another; {remedy}")
    names = dict.fromkeys(_names(tree))
    return Arithmetic(text, tree, tuple(name for name in names if name not in CONSTANTS))


class _Parser:
    """Recursive descent over the tokens of one text; `token` is the one that comes next, None at the end."""

    def __init__(self, text: str, where: str) -> None:
        self.text, self.where = text, where
        self.kind, self.token, self.begin, self.end = "", None, 0, 0
        self.advance()

    def advance(self) -> str:
        """Hands out the token that came next."""
        last = self.token or ""
        self.begin = self.end
        if not self.text[self.end :].strip():
            self.kind, self.token = "", None
            return last
        match = _TOKEN.match(self.text, self.end)
        if match is None:
            return self.refuse("only numbers, names, + - * / ** ( ) are understood")
        self.kind, self.token, self.end = str(match.lastgroup), match[str(match.lastgroup)], match.end()
        return last

    def refuse(self, reason: str) -> Any:
        rest = self.text[self.begin :].strip()
        place = f"at '{rest[:20]}'" if rest else "at its end"
        raise UserError(f"{self.where}: {self.text[:60]!r} is not a formula {place}: {reason}")

    def sum(self, depth: int) -> Tree:
        if depth > _DEEPEST:
            self.refuse(f"parentheses are nested more than {_DEEPEST} deep")
        tree = self.product(depth)
        while self.token in ("+", "-"):
            tree = (self.advance(), tree, self.product(depth))
        return tree

    def product(self, depth: int) -> Tree:
        tree = self.signed(depth)
        while self.token in ("*", "/"):
            tree = (self.advance(), tree, self.signed(depth))
        return tree

    def signed(self, depth: int) -> Tree:
        if self.token in ("+", "-"):
            sign = self.advance()
            if depth > _DEEPEST:
                self.refuse(f"signs are nested more than {_DEEPEST} deep")
            inner = self.signed(depth + 1)
            return ("negative", inner) if sign == "-" else inner
        return self.power(depth)

    def power(self, depth: int) -> Tree:
        base = self.atom(depth)
        if self.token in ("**", "^"):
            self.advance()
            if depth > _DEEPEST:
                self.refuse(f"powers are nested more than {_DEEPEST} deep")
            return ("**", base, self.signed(depth + 1))
        return base

    def atom(self, depth: int) -> Tree:
        if self.kind == "number":
            return ("number", float(self.advance()))
        if self.kind == "name":
            name = self.advance()
            if self.token != "(":
                return ("name", name)
            if name not in FUNCTIONS:
                raise UserError(f"{self.where}: {name}(...): {unknown(name, FUNCTIONS, 'function')}")
            return (name, self.enclosed(depth))
        if self.token == "(":
            return self.enclosed(depth)
        return self.refuse("a number, a name or ( is missing")

    def enclosed(self, depth: int) -> Tree:
        self.advance()
        tree = self.sum(depth + 1)
        if self.token != ")":
            self.refuse(") is missing")
        self.advance()
        return tree


def _height(tree: Tree) -> int:
    """The most operations that build on one another."""
    level, height = [tree], 0
    while level:
        level, height = [part for node in level for part in node[1:] if isinstance(part, tuple)], height + 1
    return height


def _names(tree: Tree) -> list[str]:
    found: list[str] = []
    waiting = [tree]
    while waiting:
        operation, *operands = waiting.pop()
        if operation == "name":
            found.append(operands[0])
        waiting.extend(part for part in reversed(operands) if isinstance(part, tuple))
    return found


_BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "**": operator.pow,
}


def _evaluate(tree: Tree, values: Mapping[str, Any]) -> Any:
    row = []  # a sum of many terms is as many operations in a row, deeper than Python calls
    while tree[0] in _BINARY:
        row.append(tree)
        tree = tree[1]
    result = _simple(tree, values)
    for operation, _, right in reversed(row):
        result = _BINARY[operation](result, _evaluate(right, values))
    return result


def _simple(tree: Tree, values: Mapping[str, Any]) -> Any:
    """A number, a name, a sign or a function."""
    operation, operand = tree
    if operation == "number":
        return operand
    if operation == "name":
        return values[operand] if operand in values else CONSTANTS[operand]
    value = _evaluate(operand, values)
    return -value if operation == "negative" else FUNCTIONS[operation](value)
