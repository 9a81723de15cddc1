"""Structural identifiability: which parameters of a described model no readings of its outputs can tell, however exact.

Exact readings at all times determine the Taylor coefficients of the outputs at t = 0 and nothing more. A parameter or
an initial state is locally identifiable if its column of the Jacobian of these coefficients is no combination of the
others. The rank is taken at a random point modulo a prime, so that no rounding blurs it (Sedoglavic, J. Symb. Comput.
33, 2002); it is too small only where the point is a root of a polynomial, with a probability of about degree / prime,
and a second prime repeats it. Global identifiability, such as two rates that may be swapped, is another question.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.measurements.arithmetic import Arithmetic
from ipe_bench.measurements.base import Measurement, WrappedModel
from ipe_bench.measurements.formula import Formula
from ipe_bench.measurements.ode.described import Ode
from ipe_bench.measurements.ode.trace import Expression, Graph, in_order

_PRIMES = (2147483647, 2147483629)
_POWERS = tuple(float(k) for k in range(3, 9))
"""Exponents that are multiplied out, so that the base may be zero at the start."""


@dataclass(frozen=True)
class Structure:
    """What exact readings of a model could tell."""

    unknowns: tuple[str, ...]
    lost: tuple[str, ...]
    """Those that no readings tell."""
    groups: tuple[tuple[str, ...], ...]
    """The lost ones that move together and leave every reading as it is."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """In words, a sentence per group; none if everything can be told."""
        alone = "{} moves and leaves every reading as it is; fix it, or read another output"
        together = "{} move together and leave every reading as it is; fix one of them, or read another output"
        return tuple((alone if len(g) == 1 else together).format(", ".join(g)) for g in self.groups)


def structure(model: Measurement) -> Structure | None:
    """Which parameters of a model by `Ode` or `Formula` no readings tell, locally, with the real constants of its
    cases; None for other models, and for formulas that are not examined (sin, tanh and their kin; conditionals; inputs
    or exponents that change with time; a denominator that is 0 at the start)."""
    known: dict[str, float] = {}
    while isinstance(model, WrappedModel) and not isinstance(model, Ode):
        known = {**model.fixed, **known}
        model = model.whole
    try:
        if isinstance(model, Ode):
            return _of_equations(model, known)
        if isinstance(model, Formula):
            return _of_formula(model, known)
    except (NotImplementedError, ZeroDivisionError):
        pass
    return None


def _of_equations(model: Ode, fixed: Mapping[str, float]) -> Structure:
    if model.driven_by:
        raise NotImplementedError("inputs that change with time")
    unknowns = [name for name in model.start if name not in fixed]
    constants = [dict(zip(model.constant_names, map(float, case), strict=True)) for case in model.cases]
    formulas = (model.rate_formulas, model.initial_formulas, model.output_formulas)
    return _examined(unknowns, *formulas, [{**case, **fixed} for case in constants])


def _of_formula(model: Formula, fixed: Mapping[str, float]) -> Structure:
    """A formula has no time of its own: its rows stand for cases, at any values of the columns."""
    unknowns = [p.name for p in model.parameters if p.name not in fixed]
    draw = random.Random(1)
    rows = [{i.heading: float(draw.randrange(2, 1 << 20)) for i in model.inputs} for _ in range(len(unknowns) + 1)]
    return _examined(unknowns, {}, {}, {"reading": model.arithmetic}, [{**row, **fixed} for row in rows])


def _examined(
    unknowns: Sequence[str],
    rates: Mapping[str, Arithmetic],
    initial: Mapping[str, Arithmetic],
    outputs: Mapping[str, Arithmetic],
    cases: Sequence[Mapping[str, float]],
) -> Structure:
    bases = []
    for prime in _PRIMES:
        free = _Free(prime)
        parts = [_Series(prime, free, unknowns, rates, initial, outputs, case).jacobian() for case in cases]
        bases.append(_echelon(np.concatenate(parts), prime))
    rows, pivots = max(bases, key=lambda basis: len(basis[1]))
    width = len(unknowns)
    directions = [
        {c for c in range(width) if c == f or (c in pivots and rows[pivots.index(c)][f])}
        for f in range(width)
        if f not in pivots
    ]
    groups: list[set[int]] = []
    for moved in directions:
        touched = [g for g in groups if g & moved]
        groups = [g for g in groups if not g & moved] + [moved.union(*touched)]
    named = tuple(tuple(unknowns[i] for i in sorted(g)) for g in groups)
    lost = {name for group in named for name in group}
    return Structure(tuple(unknowns), tuple(name for name in unknowns if name in lost), named)


class _Free(dict[Any, int]):
    """Random numbers modulo a prime by what they stand for: a parameter, or a function of one argument with its
    tangents. Cases share them: the same argument has the same exponential in all."""

    def __init__(self, prime: int) -> None:
        super().__init__()
        self._prime, self._random = prime, random.Random(prime)

    def __missing__(self, key: Any) -> int:
        self[key] = self._random.randrange(1, self._prime)
        return self[key]


class _Series:
    """Taylor series in t with tangents: an array (orders, 1 + unknowns) modulo a prime for every recorded expression,
    filled order by order. A state's coefficient k + 1 is its rate's coefficient k over k + 1; as many coefficients as
    unknowns suffice. exp, log, sqrt and powers enter by their differential equations (u = exp(v): u' = u v')."""

    def __init__(
        self,
        prime: int,
        free: _Free,
        unknowns: Sequence[str],
        rates: Mapping[str, Arithmetic],
        initial: Mapping[str, Arithmetic],
        outputs: Mapping[str, Arithmetic],
        known: Mapping[str, float],
    ) -> None:
        self.p, self.q, self.free = prime, len(unknowns), free
        self.orders = self.q + 1 if rates else 1
        graph = Graph()
        names = {name: graph.input(name) for name in [*unknowns, *rates, *known, "t"]}

        def record(formula: Arithmetic) -> Expression:
            value = formula({name: names[name] for name in formula.names})
            return value if isinstance(value, Expression) else graph.constant(float(value))

        self.rates = [record(formula) for formula in rates.values()]
        self.states = [names[name] for name in rates]
        self.outputs = [record(formula) for formula in outputs.values()]
        self.series = {e.order: self._zeros() for e in names.values()}
        for name, expression in names.items():
            first = self.series[expression.order][0]
            if name in unknowns:
                first[0], first[1 + unknowns.index(name)] = free[name], 1
            elif name in known:
                first[0] = self._modulo(known[name])
        if self.orders > 1:
            self.series[names["t"].order][1, 0] = 1
        for state, start in zip(self.states, [record(initial[name]) for name in rates], strict=True):
            for e in in_order([start]):
                self._fill(e, 0)
            self.series[state.order][0] = self.series[start.order][0]

    def jacobian(self) -> Any:
        """The derivatives (outputs x orders, unknowns) of the outputs' Taylor coefficients, modulo the prime."""
        everything = in_order([*self.rates, *self.outputs])
        for k in range(self.orders):
            for e in everything:
                self._fill(e, k)
            if k + 1 < self.orders:
                for state, rate in zip(self.states, self.rates, strict=True):
                    coefficient = self.series[rate.order][k] * pow(k + 1, -1, self.p) % self.p
                    self.series[state.order][k + 1] = coefficient
        return np.concatenate([self.series[e.order][:, 1:] for e in self.outputs])

    def _zeros(self) -> Any:
        return np.zeros((self.orders, 1 + self.q), np.int64)

    def _fill(self, e: Expression, k: int) -> None:
        """Coefficient k of an expression whose operands are known up to k."""
        if e.operation == "input":
            return
        u = self.series.setdefault(e.order, self._zeros())
        if e.operation == "constant":
            u[k, 0] = self._modulo(float(e.value or 0.0)) if k == 0 else 0
            return
        a, b, p = self.series[e.operands[0].order], self.series[e.operands[-1].order], self.p
        match e.operation:
            case "add":
                u[k] = (a[k] + b[k]) % p
            case "sub":
                u[k] = (a[k] - b[k]) % p
            case "neg":
                u[k] = -a[k] % p
            case "mul":
                u[k] = self._product(a, b, k)
            case "div":
                rest = (a[k] - self._product(b, u, k, 1)) % p
                u[k] = self._times(rest, self._inverse(b[0]))
            case "exp":
                u[k] = self._exponential(u, a, k)
            case "log":
                u[k] = self._logarithm(u, a, k)
            case "pow" if e.operands[1].value in _POWERS:
                u[k] = self._multiplied_out(e, a, k)
            case "sqrt":
                u[k] = self._power(u, a, np.array([pow(2, -1, p)] + [0] * self.q), k)
            case "pow" if not b[1:].any():
                u[k] = self._power(u, a, b[0], k)
            case _:
                raise NotImplementedError(e.operation)

    def _exponential(self, u: Any, a: Any, k: int) -> Any:
        if k == 0:
            value = self.free["exp", tuple(a[0])]
            return np.concatenate([[value], value * a[0, 1:] % self.p])
        total = sum(self._times(a[i] * i % self.p, u[k - i]) for i in range(1, k + 1)) % self.p
        return total * pow(k, -1, self.p) % self.p

    def _logarithm(self, u: Any, a: Any, k: int) -> Any:
        """By a u' = a'."""
        inverse = self._inverse(a[0])
        if k == 0:
            return np.concatenate([[self.free["log", tuple(a[0])]], inverse[0] * a[0, 1:] % self.p])
        rest = (a[k] * k - sum(self._times(a[k - i], u[i] * i % self.p) for i in range(1, k))) % self.p
        return self._times(rest, inverse) * pow(k, -1, self.p) % self.p

    def _multiplied_out(self, e: Expression, a: Any, k: int) -> Any:
        lower = a
        for power in range(2, int(e.operands[1].value or 0)):
            u = self.series.setdefault((e.order, power), self._zeros())  # type: ignore[call-overload]
            u[k] = self._product(lower, a, k)
            lower = u
        return self._product(lower, a, k)

    def _power(self, u: Any, a: Any, exponent: Any, k: int) -> Any:
        """Coefficient k of u = a^exponent, by a u' = exponent u a'."""
        p = self.p
        if k == 0:
            value, logarithm = self.free["pow", tuple(a[0]), tuple(exponent)], self.free["log", tuple(a[0])]
            slope = int(self._times(exponent, self._inverse(a[0]))[0]) * value % p
            return np.concatenate([[value], (slope * a[0, 1:] + value * logarithm % p * exponent[1:]) % p])
        total = sum(self._times(self._times(exponent, a[i] * i % p), u[k - i]) for i in range(1, k + 1))
        total = total - sum(self._times(a[k - i], u[i] * i % p) for i in range(1, k))
        return self._times(total % p, self._inverse(a[0])) * pow(k, -1, p) % p

    def _product(self, a: Any, b: Any, k: int, first: int = 0) -> Any:
        terms = (self._times(a[i], b[k - i]) for i in range(first, k + 1))
        return sum(terms, np.zeros(1 + self.q, np.int64)) % self.p

    def _times(self, a: Any, b: Any) -> Any:
        """The product of two numbers (1 + unknowns,) with their tangents."""
        out = a[0] * b % self.p
        out[1:] = (out[1:] + b[0] * a[1:]) % self.p
        return out

    def _inverse(self, a: Any) -> Any:
        if a[0] == 0:
            raise ZeroDivisionError("a denominator, or what a root or a power is taken of, is 0 at the start")
        value = pow(int(a[0]), -1, self.p)
        return np.concatenate([[value], -(value * value % self.p) * a[1:] % self.p])

    def _modulo(self, value: float) -> int:
        numerator, denominator = value.as_integer_ratio()
        return numerator * pow(denominator, -1, self.p) % self.p


def _echelon(J: Any, p: int) -> tuple[list[list[int]], list[int]]:
    """The reduced row echelon form of J modulo p, and its pivot columns."""
    rows, pivots = [[int(v) for v in row] for row in J], []
    for column in range(J.shape[1]):
        r = len(pivots)
        found = next((i for i in range(r, len(rows)) if rows[i][column]), None)
        if found is None:
            continue
        rows[r], rows[found] = rows[found], rows[r]
        scale = pow(rows[r][column], -1, p)
        rows[r] = [v * scale % p for v in rows[r]]
        for i, row in enumerate(rows):
            if i != r and row[column]:
                rows[i] = [(v - row[column] * w) % p for v, w in zip(row, rows[r], strict=True)]
        pivots.append(column)
    return rows[: len(pivots)], pivots
