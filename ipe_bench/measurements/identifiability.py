"""Analyses structural identifiability: which parameters of a described model no exact readings of its outputs can tell.

Exact readings at all times determine the Taylor coefficients of the outputs at t = 0 and nothing more. A parameter or
an initial state is locally identifiable if its column of the Jacobian of these coefficients is no combination of the
others. The rank is taken at a random point modulo a prime, so that no rounding blurs it (Sedoglavic, J. Symb. Comput.
33, 2002); it is too small with a probability of about degree / prime, and a second prime repeats it.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ipe_bench.measurements.arithmetic import Arithmetic
from ipe_bench.measurements.base import Forwarding, Measurement
from ipe_bench.measurements.formula import Formula
from ipe_bench.measurements.ode.described import Ode
from ipe_bench.measurements.ode.trace import Expression, Graph, in_order, tangent

_PRIMES = (2147483647, 2147483629)
_POWERS = tuple(float(k) for k in range(3, 9))
"""Exponents that are multiplied out, so that the base may be zero at the start."""


@dataclass(frozen=True)
class Structure:
    """Holds the identifiability of a model from exact readings."""

    unknowns: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    """Groups of parameters that no readings tell, as they move together and leave every reading as it is."""

    @property
    def lost(self) -> tuple[str, ...]:
        return tuple(name for name in self.unknowns if any(name in group for group in self.groups))

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the groups, one each; none if every parameter is identifiable."""
        alone = "{} moves and leaves every reading as it is; fix it, or read another output"
        together = "{} move together and leave every reading as it is; fix one of them, or read another output"
        return tuple((alone if len(g) == 1 else together).format(", ".join(g)) for g in self.groups)


def structure(model: Measurement) -> Structure | None:
    """Finds which parameters of a model by `Ode` or `Formula` no readings tell, locally, with the real constants of its
    cases; None for other models, and for formulas that are not examined (sin, tanh and their kin; conditionals; inputs
    or exponents that change with time; a denominator that is 0 at the start)."""
    fixed: dict[str, float] = {}
    while isinstance(model, Forwarding) and not isinstance(model, Ode):
        fixed = {**model.fixed, **fixed}
        model = model.whole
    unknowns = [p.name for p in model.parameters if p.name not in fixed]
    if isinstance(model, Ode) and not model.driven_by:
        formulas = (model.rate_formulas, model.initial_formulas, model.output_formulas)
        cases = [{**case, **fixed} for case in model.known_of_cases]
    elif isinstance(model, Formula):  # without time: rows stand for cases, at any values of the columns
        formulas, draw = ({}, {}, {"reading": model.arithmetic}), random.Random(1)
        rows = [{i.heading: float(draw.randrange(2, 1 << 20)) for i in model.inputs} for _ in range(len(unknowns) + 1)]
        cases = [{**row, **fixed} for row in rows]
    else:
        return None
    try:
        bases = [_echelon(_jacobian(_Free(prime), unknowns, formulas, cases), prime) for prime in _PRIMES]
    except (NotImplementedError, ZeroDivisionError):
        return None
    rows, pivots = max(bases, key=lambda basis: len(basis[1]))
    groups: list[set[int]] = []
    for free in (f for f in range(len(unknowns)) if f not in pivots):
        moved = {free} | {c for row, c in zip(rows, pivots, strict=True) if row[free]}
        touched = [g for g in groups if g & moved]
        groups = [g for g in groups if not g & moved] + [moved.union(*touched)]
    named = tuple(tuple(unknowns[i] for i in sorted(g)) for g in groups)
    return Structure(tuple(unknowns), named)


class _Free(dict[Any, int]):
    """Draws random numbers modulo a prime for parameters and for functions of one argument. Cases share them: the same
    argument has the same exponential in all."""

    def __init__(self, prime: int) -> None:
        self.prime, self._random = prime, random.Random(prime)

    def __missing__(self, key: Any) -> int:
        self[key] = self._random.randrange(1, self.prime)
        return self[key]

    def power(self, base: int, exponent: int) -> int:
        """Computes powers; those with exponents one apart, as of a power and its derivative, have the base as ratio."""
        if exponent == 0:
            return 1
        for apart in (1, -1):
            other = ("pow", base, (exponent + apart) % self.prime)
            if other in self:
                self.setdefault(("pow", base, exponent), self[other] * pow(base, -apart, self.prime) % self.prime)
        return self["pow", base, exponent]


def _jacobian(
    free: _Free, unknowns: Sequence[str], formulas: Iterable[Mapping[str, Arithmetic]], cases: list[dict[str, float]]
) -> list[list[int]]:
    """Computes the derivatives (cases x outputs x orders, unknowns) of the outputs' Taylor coefficients, modulo the
    prime, where the formulas are rates, initial states and outputs; as many coefficients as unknowns suffice."""
    graph, (rates, initial, outputs) = Graph(), formulas
    names = {name: graph.input(name) for name in [*unknowns, *rates, *cases[0], "t"]}

    def record(formulas: Iterable[Arithmetic]) -> list[Expression]:
        return [graph.apply("add", formula(names), 0.0) for formula in formulas]

    slopes, shown, starts = (record(one.values()) for one in (rates, outputs, {name: initial[name] for name in rates}))
    equations, states, columns = (slopes[:], starts[:]), [names[name] for name in rates], []
    for unknown in unknowns:
        moved = graph.inputs(f"{unknown} moves state ", len(rates))
        along = dict(zip(states, moved, strict=False)) | {names[unknown]: graph.constant(1.0)}
        columns.append(tangent(shown, along))
        slopes += tangent(equations[0], along)
        starts += tangent(equations[1], along)
        states += moved
    everything, orders = in_order([*slopes, *(e for column in columns for e in column)]), len(unknowns) + 1
    rows = []
    for case in cases:
        given = {names[name].order: [free[name]] for name in unknowns} | {names["t"].order: [0, 1]}
        given |= {names[name].order: [_modulo(value, free.prime)] for name, value in case.items()}
        begun = _Series(free, {**given})
        begun.extend(in_order(starts), 0)
        series = _Series(free, given | {y.order: [begun[e.order][0]] for y, e in zip(states, starts, strict=True)})
        for k in range(orders if rates else 1):
            series.extend(everything, k)
            for state, slope in zip(states, slopes, strict=True):
                series.given[state.order].append(series[slope.order][k] * pow(k + 1, -1, free.prime) % free.prime)
            rows += [[series[column[i].order][k] for column in columns] for i in range(len(shown))]
    return rows


class _Series(dict[int, list[int]]):
    """Computes Taylor coefficients in t modulo a prime of every recorded expression, order by order. exp, log, sqrt and
    powers enter by their differential equations (u = exp(v): u' = u v')."""

    def __init__(self, free: _Free, given: dict[int, list[int]]) -> None:
        self.free, self.p, self.given = free, free.prime, given

    def extend(self, expressions: Sequence[Expression], k: int) -> None:
        """Computes coefficient k of all expressions, operands before their users."""
        for e in expressions:
            self.setdefault(e.order, []).append(self._coefficient(e, k) % self.p)

    def _coefficient(self, e: Expression, k: int) -> int:
        if e.operation == "input":
            known = self.given[e.order]
            return known[k] if k < len(known) else 0
        if e.operation == "constant":
            return 0 if k else _modulo(e.value or 0.0, self.p)
        u, (a, *_), b = self[e.order], [self[o.order] for o in e.operands], self[e.operands[-1].order]
        match e.operation:
            case "add":
                return a[k] + b[k]
            case "sub":
                return a[k] - b[k]
            case "neg":
                return -a[k]
            case "mul":
                return _product(a, b, k)
            case "div":
                if e.operands[1].operation == "sqrt" and e.operands[0].value == 0.5:
                    # The derivative of u = sqrt(v) as u / (2 v), since a random number u is no root of v.
                    a = [_product(a, b, i) for i in range(k + 1)]
                    b = self[e.operands[1].operands[0].order]
                return (a[k] - _product(b[1:], u, k - 1)) * self._inverse(b[0])
            case "exp":
                return _product(_derivative(a), u, k - 1) * pow(k, -1, self.p) if k else self.free["exp", a[0]]
            case "log":
                rest = _derivative(a)[k - 1] - _product(_derivative(u), a[1:], k - 2) if k else 0
                return rest * self._inverse(k * a[0]) if k else self.free["log", a[0]]
            case "where" if a[0]:  # of a power's derivative: what is not 0 here is not 0 nearby
                return self[e.operands[1].order][k]
            case "pow" if e.operands[1].value in _POWERS:
                power = a
                for _ in range(1, int(e.operands[1].value or 0)):
                    power = [_product(power, a, i) % self.p for i in range(k + 1)]
                return power[k]
            case "sqrt":
                return self._power(u, a, pow(2, -1, self.p), k)
            case "pow" if not any(b[1:]):
                return self._power(u, a, b[0], k)
        raise NotImplementedError(e.operation)

    def _power(self, u: list[int], a: list[int], exponent: int, k: int) -> int:
        """Computes a coefficient of u = a^exponent, by a u' = exponent u a'."""
        inverse = self._inverse(max(k, 1) * a[0])
        rest = exponent * _product(_derivative(a), u, k - 1) - _product(_derivative(u), a[1:], k - 2)
        return rest * inverse if k else self.free.power(a[0], exponent)

    def _inverse(self, value: int) -> int:
        if value == 0:
            raise ZeroDivisionError
        return pow(value, -1, self.p)


def _product(a: Sequence[int], b: Sequence[int], k: int) -> int:
    """Computes coefficient k of a product of series."""
    return sum(a[i] * b[k - i] for i in range(k + 1))


def _derivative(a: Sequence[int]) -> list[int]:
    return [i * v for i, v in enumerate(a)][1:]


def _modulo(value: float, prime: int) -> int:
    numerator, denominator = value.as_integer_ratio()
    return numerator * pow(denominator, -1, prime) % prime


def _echelon(J: list[list[int]], p: int) -> tuple[list[list[int]], list[int]]:
    """Computes the reduced row echelon form of J modulo p, and its pivot columns."""
    rows, pivots = J, []
    for column in range(len(J[0])):
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
