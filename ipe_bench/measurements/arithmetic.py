"""The language of formulas: numbers, names, + - * / ** ( ), elementary functions, comparisons and `A if C else B`.

Text becomes a tree, and a tree is evaluated on whatever numbers, arrays or recorded expressions it is given. Nothing is
handed to Python's own interpreter. What the names stand for is left to the models that are written in this language.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, did_you_mean, unknown
from ipe_bench.measurements.ode.trace import special


def choose(condition: Any, a: Any, b: Any) -> Any:
    """a where the condition is not 0, b elsewhere."""
    return (a if condition else b) if isinstance(condition, float) else np.where(condition, a, b)


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
    "erf": special("erf"),
    "erfc": special("erfc"),
    "abs": lambda a: choose(np.less(a, 0.0) * 1.0, -a, a),  # NumPy's drops the imaginary part of a complex step
}
"""Functions of one argument; log is the natural logarithm."""
SEVERAL: dict[str, Callable[[Any, Any], Any]] = {"min": np.minimum, "max": np.maximum}
"""Functions of two arguments or more."""
COMPARISONS = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
COMPARISONS |= {"==": np.equal, "!=": np.not_equal}
"""They are 1 where they hold and 0 elsewhere."""
_WORDS = ("if", "else", "and", "or", "not")
CONSTANTS = {"pi": math.pi}
_LONGEST = 10_000
_DEEPEST = 50
_MOST_IN_A_ROW = 400
"""Operations that build on one another, as in a sum of so many terms."""
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<sign>\*\*|[<>=!]=|[-+*/^(),<>]))",
    re.ASCII,
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
            hint = did_you_mean(name, parameters)
            raise UserError(f"{where}: {name} is not a parameter{hint} (these are {', '.join(parameters)})")


def read(text: str, where: str) -> Arithmetic:
    """Reads a formula; `where` is the config key, for messages.

    ** (or ^) binds from the right and before a minus in front: -x**2 is -(x**2). Comparisons, `and`, `or`, `not` and
    `A if C else B` are those of Python, also in a row: 2 <= t < 5. The branch that a conditional does not take
    need not have a value.

    Raises:
        UserError: the text is not a formula of this language, by the place where it ceases to be one.
    """
    if len(text) > _LONGEST:
        raise UserError(f"{where}: is longer than {_LONGEST} characters")
    parser = _Parser(text, where)
    tree = parser.conditional(0)
    if parser.token is not None:
        parser.refuse("an operator such as + - * / ** is missing")
    if _height(tree) > _MOST_IN_A_ROW:
        remedy = "group terms by parentheses, or write the model in Python (`ipe-bench new measurement`)"
        raise UserError(f"{where}: has more than {_MOST_IN_A_ROW} operations one after another; {remedy}")
    names = dict.fromkeys(names_in(tree))
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
            return self.refuse("only numbers, names, + - * / ** ( ), comparisons and `A if C else B` are understood")
        self.kind, self.token, self.end = str(match.lastgroup), match[str(match.lastgroup)], match.end()
        return last

    def refuse(self, reason: str) -> Any:
        rest = self.text[self.begin :].strip()
        place = f"at '{rest[:20]}'" if rest else "at its end"
        raise UserError(f"{self.where}: {self.text[:60]!r} is not a formula {place}: {reason}")

    def expect(self, token: str) -> None:
        if self.token != token:
            self.refuse(f"{token} is missing")
        self.advance()

    def deeper(self, depth: int, what: str) -> int:
        if depth > _DEEPEST:
            self.refuse(f"{what} are nested more than {_DEEPEST} deep")
        return depth + 1

    def row(self, operators: Collection[str], operand: Callable[[int], Tree], depth: int) -> Tree:
        """Operands with operators between them, which bind from the left."""
        tree = operand(depth)
        while self.token in operators:
            tree = (self.advance(), tree, operand(depth))
        return tree

    def conditional(self, depth: int) -> Tree:
        deeper = self.deeper(depth, "parentheses")
        tree = self.either(depth)
        if self.token != "if":
            return tree
        self.advance()
        condition = self.either(depth)
        self.expect("else")
        return ("if", condition, tree, self.conditional(deeper))

    def either(self, depth: int) -> Tree:
        return self.row(["or"], self.both, depth)

    def both(self, depth: int) -> Tree:
        return self.row(["and"], self.comparison, depth)

    def comparison(self, depth: int) -> Tree:
        if self.token == "not":
            self.advance()
            return ("if", self.comparison(self.deeper(depth, "negations")), ("number", 0.0), ("number", 1.0))
        begin = self.begin
        tree = left = self.sum(depth)
        while self.token in COMPARISONS:
            sign, right = self.advance(), self.sum(depth)
            held = (sign, left, right, self.text[begin : self.begin].strip())
            tree, left = held if tree is left else ("and", tree, held), right
        return tree

    def sum(self, depth: int) -> Tree:
        return self.row(["+", "-"], self.product, depth)

    def product(self, depth: int) -> Tree:
        return self.row(["*", "/"], self.signed, depth)

    def signed(self, depth: int) -> Tree:
        if self.token in ("+", "-"):
            sign = self.advance()
            inner = self.signed(self.deeper(depth, "signs"))
            return ("negative", inner) if sign == "-" else inner
        return self.power(depth)

    def power(self, depth: int) -> Tree:
        base = self.atom(depth)
        if self.token in ("**", "^"):
            self.advance()
            return ("**", base, self.signed(self.deeper(depth, "powers")))
        return base

    def atom(self, depth: int) -> Tree:
        if self.kind == "number":
            return ("number", float(self.advance()))
        if self.kind == "name" and self.token not in _WORDS:
            name = self.advance()
            if self.token != "(":
                return ("name", name)
            return self.call(name, depth)
        if self.token == "(":
            self.advance()
            tree = self.conditional(depth + 1)
            self.expect(")")
            return tree
        return self.refuse("a number, a name or ( is missing")

    def call(self, name: str, depth: int) -> Tree:
        if name not in FUNCTIONS and name not in SEVERAL:
            raise UserError(f"{self.where}: {name}(...): {unknown(name, [*FUNCTIONS, *SEVERAL], 'function')}")
        self.advance()
        tree = self.conditional(depth + 1)
        if name in SEVERAL and self.token != ",":
            self.refuse(f"{name} takes two arguments or more")
        while name in SEVERAL and self.token == ",":
            self.advance()
            tree = (name, tree, self.conditional(depth + 1))
        self.expect(")")
        return tree if name in SEVERAL else (name, tree)


def parts(tree: Tree) -> list[Tree]:
    """The tree and all trees in it, in order of appearance."""
    found, waiting = [], [tree]
    while waiting:
        found.append(waiting.pop())
        waiting.extend(part for part in reversed(found[-1]) if isinstance(part, tuple))
    return found


def names_in(tree: Tree) -> list[str]:
    return [part[1] for part in parts(tree) if part[0] == "name"]


def comparisons(formulas: Mapping[str, Arithmetic]) -> list[tuple[str, Tree]]:
    """Every comparison in some formulas, each once, with the key of its formula."""
    found: dict[Tree, str] = {}
    for where, formula in formulas.items():
        for part in parts(formula.tree):
            if part[0] in COMPARISONS:
                found.setdefault(part, where)
    return [(where, part) for part, where in found.items()]


def never_switches(where: str, comparison: Tree, met: Any) -> list[str]:
    """A sentence if a comparison, which holds where `met` is not 0, holds for all readings or for none."""
    if not (np.all(met) or not np.any(met)):
        return []
    said = "holds at every reading" if np.all(met) else "holds at no reading"
    return [f"measurement.{where}: {comparison[3]} {said}, so these readings say nothing of the other branch"]


def rewritten(tree: Tree, new: Callable[[Tree], Tree | None]) -> Tree:
    """The tree with every tree in it replaced for which `new` has another."""
    other = new(tree)
    if other is not None:
        return other
    return tuple(rewritten(part, new) if isinstance(part, tuple) else part for part in tree)


def _height(tree: Tree) -> int:
    """The most operations that build on one another."""
    level, height = [tree], 0
    while level:
        level, height = [part for node in level for part in node[1:] if isinstance(part, tuple)], height + 1
    return height


_BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "**": operator.pow,
    "and": lambda a, b: choose(a, b, a),
    "or": lambda a, b: choose(a, a, b),
    **SEVERAL,
    **{sign: lambda a, b, holds=holds: holds(a, b) * 1.0 for sign, holds in COMPARISONS.items()},
}


def _evaluate(tree: Tree, values: Mapping[str, Any]) -> Any:
    row = []  # a sum of many terms is as many operations in a row, deeper than Python calls
    while tree[0] in _BINARY:
        row.append(tree)
        tree = tree[1]
    result = _simple(tree, values)
    for operation, _, right, *_ in reversed(row):
        result = _BINARY[operation](result, _evaluate(right, values))
    return result


def _simple(tree: Tree, values: Mapping[str, Any]) -> Any:
    """A number, a name, a sign, a function or a conditional."""
    operation, operand, *branches = tree
    if operation == "number":
        return operand
    if operation == "name":
        return values[operand] if operand in values else CONSTANTS[operand]
    value = _evaluate(operand, values)
    if operation == "if":
        if isinstance(value, float):  # the other branch may have no value
            return _evaluate(branches[0] if value else branches[1], values)
        return choose(value, *(_evaluate(branch, values) for branch in branches))
    return -value if operation == "negative" else FUNCTIONS[operation](value)
