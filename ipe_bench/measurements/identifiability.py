"""Analyses structural identifiability: which parameters of a described model no exact readings of its outputs can tell.

Exact readings at all times determine the Taylor coefficients of the outputs at t = 0 and nothing more. A parameter or
an initial state is locally identifiable if its column of the Jacobian of these coefficients is no combination of the
others. The rank is taken at a random point modulo a prime, so that no rounding blurs it (Sedoglavic, J. Symb. Comput.
33, 2002); it is too small with a probability of about degree / prime.

From a general start the rank of n unknowns is complete after n orders. Where states start at 0 it may stand still in
between, so more orders follow, and the Jacobian of the readings has the last word.
"""

from __future__ import annotations

import itertools
import operator
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.engine.trace import Expression, Graph, in_order, tangent
from ipe_bench.measurements.arithmetic import Arithmetic
from ipe_bench.measurements.base import Forwarding, Measurement
from ipe_bench.measurements.formula import Formula
from ipe_bench.measurements.ode.described import Ode

_PRIME = (1 << 61) - 1
_POWERS = tuple(float(k) for k in range(3, 9))
"""Exponents that are multiplied out, so that the base may be zero at the start."""
_LONGEST = 200_000
"""Coefficients of expressions, some two seconds, after which an examination ends without an answer."""
_SEEN = 1e-6
"""Least relative size of what counts as different from 0 in a Jacobian that was integrated."""


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
    cases.

    Returns None for other models, for formulas that are not examined (sin, tanh and their kin; conditionals; inputs or
    exponents that change with time; a denominator that is 0 at the start), for models so large that it would take long,
    and where the readings at the nominal point determine more than the coefficients that were examined.
    """
    fixed: dict[str, float] = {}
    described = model
    while isinstance(described, Forwarding) and not isinstance(described, Ode):
        fixed = {**described.fixed, **fixed}
        described = described.whole
    unknowns = [p.name for p in described.parameters if p.name not in fixed]
    if isinstance(described, Ode) and not described.driven_by:
        formulas = (described.rate_formulas, described.initial_formulas, described.output_formulas)
        cases = [{**case, **fixed} for case in described.known_of_cases]
    elif isinstance(
        described, Formula
    ):  # without time: rows stand for cases, at any values of the columns
        formulas, draw = ({}, {}, {"reading": described.arithmetic}), random.Random(1)
        headings = [i.heading for i in described.inputs]
        rows = [
            {name: float(draw.randrange(2, 1 << 20)) for name in headings}
            for _ in range(len(unknowns) + 1)
        ]
        cases = [{**row, **fixed} for row in rows]
    else:
        return None
    try:
        basis = _independent(_Free(_PRIME), unknowns, formulas, cases)
    except (NotImplementedError, ZeroDivisionError):
        return None
    lacking = len(basis) < len(unknowns)
    if lacking and model.n == len(unknowns) and _rank(model) > len(basis):
        return None
    groups: list[set[int]] = []
    for free in (f for f in range(len(unknowns)) if f not in basis):
        moved = {free} | {pivot for pivot, row in basis.items() if row[free]}
        touched = [g for g in groups if g & moved]
        groups = [g for g in groups if not g & moved] + [moved.union(*touched)]
    named = tuple(tuple(unknowns[i] for i in sorted(g)) for g in groups)
    return Structure(tuple(unknowns), named)


def _rank(model: Measurement) -> int:
    """Computes how many parameters or combinations of them the readings determine at the nominal point, at least."""
    if not model.input_columns_known:
        return 0
    x = model.nominal[None]
    with np.errstate(all="ignore"):
        J, z = model.jacobian(x)[0], model.simulate(x)[0]
    if not (np.isfinite(J).all() and np.isfinite(z).all()):
        return 0
    lengths = np.linalg.norm(J, axis=0)
    moving = lengths > _SEEN * np.linalg.norm(z)
    return (
        int(np.linalg.matrix_rank(J[:, moving] / lengths[moving], rtol=_SEEN))
        if moving.any()
        else 0
    )


class _Free(dict[Any, int]):
    """Draws random numbers modulo a prime for parameters and for functions of one argument. Cases share them: the same
    argument has the same exponential in all."""

    def __init__(self, prime: int) -> None:
        super().__init__({("exp", 0): 1, ("log", 1): 0})
        self.prime, self._random = prime, random.Random(prime)

    def __missing__(self, key: Any) -> int:
        self[key] = self._random.randrange(1, self.prime)
        return self[key]

    def power(self, base: int, exponent: int) -> int:
        """Computes powers; those with exponents one apart, as of a power and its derivative, have the base as ratio."""
        if exponent == 0 or base == 1:
            return 1
        for apart in (1, -1):
            other = ("pow", base, (exponent + apart) % self.prime)
            if other in self:
                self.setdefault(
                    ("pow", base, exponent),
                    self[other] * pow(base, -apart, self.prime) % self.prime,
                )
        return self["pow", base, exponent]


def _independent(
    free: _Free,
    unknowns: Sequence[str],
    formulas: Iterable[Mapping[str, Arithmetic]],
    cases: list[dict[str, float]],
) -> _Basis:
    """Finds the independent ones among the derivatives by the unknowns of the outputs' Taylor coefficients, modulo the
    prime, where the formulas are rates, initial states and outputs."""
    graph, (rates, initial, outputs) = Graph(), formulas
    names = {name: graph.input(name) for name in [*unknowns, *rates, *cases[0], "t"]}

    def record(formulas: Iterable[Arithmetic]) -> list[Expression]:
        return [graph.apply("add", formula(names), 0.0) for formula in formulas]

    slopes, shown, starts = (
        record(one.values()) for one in (rates, outputs, {name: initial[name] for name in rates})
    )
    equations, states, columns = (slopes[:], starts[:]), [names[name] for name in rates], []
    for unknown in unknowns:
        moved = graph.inputs(f"{unknown} moves state ", len(rates))
        along = dict(zip(states, moved, strict=False)) | {names[unknown]: graph.constant(1.0)}
        columns.append(tangent(shown, along))
        slopes += tangent(equations[0], along)
        starts += tangent(equations[1], along)
        states += moved
    everything = in_order([*slopes, *(e for column in columns for e in column)])

    def orders(case: dict[str, float]) -> Iterator[tuple[list[list[int]], bool]]:
        """Yields the derivatives (outputs, unknowns) of one coefficient after the other, and whether every state that
        ever moves has moved."""
        given = {names[name].order: [free[name]] for name in unknowns} | {names["t"].order: [0, 1]}
        given |= {names[name].order: [_modulo(value, free.prime)] for name, value in case.items()}
        begun = _Series(free, {**given})
        begun.extend(in_order(starts), 0)
        given |= {y.order: [begun[e.order][0]] for y, e in zip(states, starts, strict=True)}
        later = given | {names["t"].order: [free["t"]]}
        moving = _moving(free, dict(zip(states, equations[0], strict=False)), later)
        series = _Series(free, given)
        for k in itertools.count():
            series.extend(everything, k)
            rows = [[series[column[i].order][k] for column in columns] for i in range(len(shown))]
            yield rows, all(any(series.given[y.order]) for y in moving)
            for state, slope in zip(states, slopes, strict=True):
                series.given[state.order].append(
                    series[slope.order][k] * pow(k + 1, -1, free.prime) % free.prime
                )

    basis = _Basis(free.prime)
    grown = moved = 0
    for k, cases_at_k in enumerate(zip(*map(orders, cases), strict=True)):
        known = len(basis)
        for rows, all_move in cases_at_k:
            for row in rows:
                basis.add(row)
            moved = moved if all_move else k + 1
        grown = k if len(basis) > known else grown
        # The slopes of a linear model of n states, driven by constants, satisfy a linear equation of order 2 n + 2: as
        # many zeros are followed by zeros alone. What begins at order k begins to depart from its beginning, as
        # y^4 / (K + y^4) does from y^4 / K, at order 2 k.
        if (
            len(basis) == len(unknowns)
            or not rates
            or k - max(grown, moved) > 2 * len(rates) + 2 + moved
        ):
            break
        if k * len(everything) * len(cases) > _LONGEST:
            raise NotImplementedError("a model of this size")
    return basis


def _moving(
    free: _Free, slopes: Mapping[Expression, Expression], given: Mapping[int, list[int]]
) -> tuple[Expression, ...]:
    """Finds the states that do not stay at 0 for ever."""
    at_rest = [y for y in slopes if not any(given[y.order])]
    while True:
        anywhere = {y.order: [free[y]] for y in slopes} | {y.order: [0] for y in at_rest}
        series = _Series(free, {**given, **anywhere})
        series.extend(in_order(slopes.values()), 0)
        resting = [y for y in at_rest if series[slopes[y].order] == [0]]
        if resting == at_rest:
            return tuple(y for y in slopes if y not in at_rest)
        at_rest = resting


class _Series(dict[int, list[int]]):
    """Computes Taylor coefficients in t modulo a prime of every recorded expression, order by order. exp, log, sqrt and
    powers enter by their differential equations (u = exp(v): u' = u v')."""

    def __init__(self, free: _Free, given: dict[int, list[int]]) -> None:
        self.free, self.p, self.given = free, free.prime, given
        self.powers: dict[int, list[list[int]]] = {}

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
        u, (a, *_), b = (
            self[e.order],
            [self[o.order] for o in e.operands],
            self[e.operands[-1].order],
        )
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
                return (
                    _product(_derivative(a), u, k - 1) * pow(k, -1, self.p)
                    if k
                    else self.free["exp", a[0]]
                )
            case "log":
                rest = _derivative(a)[k - 1] - _product(_derivative(u), a[1:], k - 2) if k else 0
                return rest * self._inverse(k * a[0]) if k else self.free["log", a[0]]
            case "where" if a[0]:  # of a power's derivative: what is not 0 here is not 0 nearby
                return self[e.operands[1].order][k]
            case "pow" if e.operands[1].value in _POWERS:
                powers = self.powers.setdefault(
                    e.order, [[] for _ in range(1, int(e.operands[1].value or 0))]
                )
                for lower, higher in itertools.pairwise([a, *powers]):
                    higher.append(_product(lower, a, k) % self.p)
                return powers[-1][k]
            case "sqrt":
                return self._power(u, a, pow(2, -1, self.p), k)
            case "pow" if not any(b[1:]):
                return self._power(u, a, b[0], k)
        raise NotImplementedError(e.operation)

    def _power(self, u: list[int], a: list[int], exponent: int, k: int) -> int:
        """Computes a coefficient of u = a^exponent, by a u' = exponent u a'."""
        inverse = self._inverse(max(k, 1) * a[0])
        rest = exponent * _product(_derivative(a), u, k - 1) - _product(
            _derivative(u), a[1:], k - 2
        )
        return rest * inverse if k else self.free.power(a[0], exponent)

    def _inverse(self, value: int) -> int:
        if value == 0:
            raise ZeroDivisionError
        return pow(value, -1, self.p)


def _product(a: Sequence[int], b: Sequence[int], k: int) -> int:
    """Computes coefficient k of a product of series."""
    return sum(map(operator.mul, a[: k + 1], b[k::-1])) if k >= 0 else 0


def _derivative(a: Sequence[int]) -> list[int]:
    return [i * v for i, v in enumerate(a)][1:]


def _modulo(value: float, prime: int) -> int:
    numerator, denominator = value.as_integer_ratio()
    return numerator * pow(denominator, -1, prime) % prime


class _Basis(dict[int, list[int]]):
    """Holds independent rows modulo a prime by their pivot columns; in each of these all other rows are 0."""

    def __init__(self, prime: int) -> None:
        super().__init__()
        self.p = prime

    def add(self, row: list[int]) -> None:
        """Adds a row, unless it is a combination of those that are there."""
        for pivot, known in self.items():
            row = self._without(pivot, row, known)
        pivot = next((column for column, value in enumerate(row) if value), None)
        if pivot is None:
            return
        scale = pow(row[pivot], -1, self.p)
        row = [value * scale % self.p for value in row]
        for other, known in self.items():
            self[other] = self._without(pivot, known, row)
        self[pivot] = row

    def _without(self, pivot: int, row: list[int], known: list[int]) -> list[int]:
        """Subtracts what makes a row 0 in the pivot column of a known one."""
        factor = row[pivot]
        return (
            [(v - factor * w) % self.p for v, w in zip(row, known, strict=True)] if factor else row
        )
