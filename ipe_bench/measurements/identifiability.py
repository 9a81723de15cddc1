"""Analyses structural identifiability: which parameters of a described model no exact readings of
its outputs can tell.

Exact readings at all times determine the Taylor coefficients of the outputs at t = 0 and nothing
more. A parameter or an initial state is locally identifiable if its column of the Jacobian of these
coefficients is no combination of the others. The rank is taken at a random point modulo a prime, so
that no rounding blurs it (Sedoglavic, J. Symb. Comput. 33, 2002); it is too small with a
probability of about degree / prime.

From a general start the rank of n unknowns is complete after n orders. Where states start at 0 it
may stand still in between, so more orders follow, and the Jacobian of the readings has the last
word.
"""

from __future__ import annotations

import itertools
import operator
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

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
"""Coefficients of expressions, some two seconds, after which an examination ends without an
answer."""
_SEEN = 1e-6
"""Least relative size of what counts as different from 0 in a Jacobian that was integrated."""


@dataclass(frozen=True)
class Structure:
    """Holds the identifiability of a model from exact readings."""

    unknowns: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    """Groups of parameters that can change together without changing any reading."""

    @property
    def lost(self) -> tuple[str, ...]:
        return tuple(name for name in self.unknowns if any(name in group for group in self.groups))

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the groups, one each; none if every parameter is identifiable."""
        return tuple(map(_sentence, self.groups))


def _sentence(group: Sequence[str]) -> str:
    if len(group) == 1:
        return f"{group[0]} can change without changing any reading; fix it, or read another output"
    names = ", ".join(group)
    return (
        f"{names} can change together without changing any reading;"
        " fix one of them, or read another output"
    )


class _Examined(NamedTuple):
    """Holds the formulas of a model, with the constants of each of its cases."""

    rates: Mapping[str, Arithmetic]
    initial: Mapping[str, Arithmetic]
    outputs: Mapping[str, Arithmetic]
    cases: list[dict[str, float]]


def structure(model: Measurement) -> Structure | None:
    """Finds which parameters of a model by `Ode` or `Formula` no readings tell, locally, with the
    real constants of its cases.

    Returns None for other models, for formulas that are not examined (sin, tanh and their kin;
    conditionals; inputs or exponents that change with time; a denominator that is 0 at the start),
    for models so large that it would take long, and where the readings at the start
    determine more than the coefficients that were examined.
    """
    fixed: dict[str, float] = {}
    described = model
    while isinstance(described, Forwarding) and not isinstance(described, Ode):
        fixed = {**described.fixed, **fixed}
        described = described.whole
    unknowns = [p.name for p in described.parameters if p.name not in fixed]
    examined = _examined(described, fixed, len(unknowns))
    if examined is None:
        return None
    try:
        basis = _independent(_Free(_PRIME), unknowns, examined)
    except (NotImplementedError, ZeroDivisionError):
        return None
    lacking = len(basis) < len(unknowns)
    if lacking and model.n == len(unknowns) and _rank(model) > len(basis):
        return None
    groups = _groups(basis, len(unknowns))
    named = tuple(tuple(unknowns[i] for i in sorted(group)) for group in groups)
    return Structure(tuple(unknowns), named)


def _examined(model: Measurement, fixed: Mapping[str, float], unknowns: int) -> _Examined | None:
    """Returns the formulas of a model, with what is fixed among the constants; None if it has
    none."""
    if isinstance(model, Ode) and not model.driven_by:
        cases = [{**case, **fixed} for case in model.known_of_cases]
        return _Examined(model.rate_formulas, model.initial_formulas, model.output_formulas, cases)
    if isinstance(model, Formula):
        # Without time: rows stand for cases, at any values of the columns.
        draw = random.Random(1)
        headings = [i.heading for i in model.inputs]
        cases = []
        for _ in range(unknowns + 1):
            row = {name: float(draw.randrange(2, 1 << 20)) for name in headings}
            cases.append({**row, **fixed})
        return _Examined({}, {}, {"reading": model.arithmetic}, cases)
    return None


def _groups(basis: _Basis, unknowns: int) -> list[set[int]]:
    """Groups the unknowns that move together: each that is free with those that it moves."""
    groups: list[set[int]] = []
    for free in range(unknowns):
        if free in basis:
            continue
        moved = {free} | {pivot for pivot, row in basis.items() if row[free]}
        touched = [group for group in groups if group & moved]
        apart = [group for group in groups if not group & moved]
        groups = [*apart, moved.union(*touched)]
    return groups


def _rank(model: Measurement) -> int:
    """Computes how many parameters or combinations of them the readings determine at the
    start, at least."""
    if not model.input_columns_known:
        return 0
    x = model.nominal[None]
    with np.errstate(all="ignore"):
        J = model.jacobian(x)[0]
        z = model.simulate(x)[0]
    if not (np.isfinite(J).all() and np.isfinite(z).all()):
        return 0
    lengths = np.linalg.norm(J, axis=0)
    moving = lengths > _SEEN * np.linalg.norm(z)
    if not moving.any():
        return 0
    directions = J[:, moving] / lengths[moving]
    return int(np.linalg.matrix_rank(directions, rtol=_SEEN))


class _Free(dict[Any, int]):
    """Draws random numbers modulo a prime for parameters and for functions of one argument. Cases
    share them: the same argument has the same exponential in all."""

    def __init__(self, prime: int) -> None:
        super().__init__({("exp", 0): 1, ("log", 1): 0})
        self.prime = prime
        self._random = random.Random(prime)

    def __missing__(self, key: Any) -> int:
        self[key] = self._random.randrange(1, self.prime)
        return self[key]

    def power(self, base: int, exponent: int) -> int:
        """Computes powers; those with exponents one apart, as of a power and its derivative, have
        the base as ratio."""
        if exponent == 0 or base == 1:
            return 1
        for apart in (1, -1):
            other = ("pow", base, (exponent + apart) % self.prime)
            if other in self:
                value = self[other] * pow(base, -apart, self.prime) % self.prime
                self.setdefault(("pow", base, exponent), value)
        return self["pow", base, exponent]


def _independent(free: _Free, unknowns: Sequence[str], examined: _Examined) -> _Basis:
    """Finds the independent ones among the derivatives by the unknowns of the outputs' Taylor
    coefficients, modulo the prime."""
    recorded = _recorded(unknowns, examined)
    states = len(examined.rates)
    cases = [_orders(free, unknowns, recorded, case) for case in examined.cases]
    work = len(recorded.everything) * len(cases)
    basis = _Basis(free.prime)
    grown = moved = 0
    for k, cases_at_k in enumerate(zip(*cases, strict=True)):
        known = len(basis)
        for rows, all_move in cases_at_k:
            for row in rows:
                basis.add(row)
            if not all_move:
                moved = k + 1
        if len(basis) > known:
            grown = k
        if len(basis) == len(unknowns) or not states:
            break
        # The slopes of a linear model of n states, driven by constants, satisfy a linear equation
        # of order 2 n + 2: as many zeros are followed by zeros alone. What begins at order k begins
        # to depart from its beginning, as y^4 / (K + y^4) does from y^4 / K, at order 2 k.
        if k - max(grown, moved) > 2 * states + 2 + moved:
            break
        if k * work > _LONGEST:
            raise NotImplementedError("a model of this size")
    return basis


class _Recorded(NamedTuple):
    """Holds recorded equations, with those of the derivatives of states and outputs by each
    unknown."""

    names: dict[str, Expression]
    states: list[Expression]
    """The states, and behind them their derivatives by each unknown."""
    rates: list[Expression]
    """Time derivatives of the states alone."""
    slopes: list[Expression]
    """Time derivatives of `states`."""
    starts: list[Expression]
    """Their values at t = 0."""
    columns: list[list[Expression]]
    """Derivatives of the outputs by each unknown."""
    everything: list[Expression]
    """All that slopes and columns are made of, operands before their users."""


def _recorded(unknowns: Sequence[str], examined: _Examined) -> _Recorded:
    """Records the equations; those of a derivative s by an unknown are s' = df/dy s + df/dp."""
    graph = Graph()
    inputs = [*unknowns, *examined.rates, *examined.cases[0], "t"]
    names = {name: graph.input(name) for name in inputs}

    def record(formulas: Iterable[Arithmetic]) -> list[Expression]:
        return [graph.apply("add", formula(names), 0.0) for formula in formulas]

    rates = record(examined.rates.values())
    outputs = record(examined.outputs.values())
    initial = record(examined.initial[name] for name in examined.rates)
    states = [names[name] for name in examined.rates]
    slopes = rates[:]
    starts = initial[:]
    columns = []
    for unknown in unknowns:
        moved = graph.inputs(f"{unknown} moves state ", len(rates))
        along = dict(zip(states, moved, strict=False))
        along[names[unknown]] = graph.constant(1.0)
        columns.append(tangent(outputs, along))
        slopes += tangent(rates, along)
        starts += tangent(initial, along)
        states += moved
    everything = in_order([*slopes, *itertools.chain.from_iterable(columns)])
    return _Recorded(names, states, rates, slopes, starts, columns, everything)


def _orders(
    free: _Free, unknowns: Sequence[str], recorded: _Recorded, case: Mapping[str, float]
) -> Iterator[tuple[list[list[int]], bool]]:
    """Yields the derivatives (outputs, unknowns) of one coefficient after the other, and whether
    every state that ever moves has moved."""
    names, states, rates, slopes, starts, columns, everything = recorded
    t = names["t"].order
    given = {names[name].order: [free[name]] for name in unknowns}
    given[t] = [0, 1]
    for name, value in case.items():
        given[names[name].order] = [_modulo(value, free.prime)]
    begun = _Series(free, {**given})
    begun.extend(in_order(starts), 0)
    given |= {y.order: [begun[e.order][0]] for y, e in zip(states, starts, strict=True)}
    moving = _moving(free, dict(zip(states, rates, strict=False)), given | {t: [free["t"]]})
    series = _Series(free, given)
    outputs = list(zip(*columns, strict=True))
    for k in itertools.count():
        series.extend(everything, k)
        rows = [[series[e.order][k] for e in output] for output in outputs]
        yield rows, all(any(series.given[y.order]) for y in moving)
        # y' = sum of slope_k t^k: the next coefficient of y is slope_k / (k + 1).
        inverse = pow(k + 1, -1, free.prime)
        for state, slope in zip(states, slopes, strict=True):
            following = series[slope.order][k] * inverse % free.prime
            series.given[state.order].append(following)


def _moving(
    free: _Free, slopes: Mapping[Expression, Expression], given: Mapping[int, list[int]]
) -> tuple[Expression, ...]:
    """Finds the states that do not stay at 0 for ever."""
    at_rest = [y for y in slopes if not any(given[y.order])]
    while True:
        # A state stays at 0 if its slope is 0 wherever the others are, and if those at rest stay
        # there.
        anywhere = {y.order: [free[y]] for y in slopes}
        anywhere |= {y.order: [0] for y in at_rest}
        series = _Series(free, {**given, **anywhere})
        series.extend(in_order(slopes.values()), 0)
        resting = [y for y in at_rest if series[slopes[y].order] == [0]]
        if resting == at_rest:
            return tuple(y for y in slopes if y not in at_rest)
        at_rest = resting


class _Series(dict[int, list[int]]):
    """Computes Taylor coefficients in t modulo a prime of every recorded expression, order by
    order. exp, log, sqrt and powers enter by their differential equations (u = exp(v): u' = u
    v')."""

    def __init__(self, free: _Free, given: dict[int, list[int]]) -> None:
        self.free = free
        self.p = free.prime
        self.given = given
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
        u = self[e.order]
        a = self[e.operands[0].order]
        b = self[e.operands[-1].order]
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
                    # The derivative of u = sqrt(v) as u / (2 v), since a random number u is no root
                    # of v.
                    a = [_product(a, b, i) for i in range(k + 1)]
                    b = self[e.operands[1].operands[0].order]
                return (a[k] - _product(b[1:], u, k - 1)) * self._inverse(b[0])
            case "exp" if k == 0:
                return self.free["exp", a[0]]
            case "exp":  # k u_k = sum of i a_i u_(k - i)
                return _product(_derivative(a), u, k - 1) * pow(k, -1, self.p)
            case "log" if k == 0:
                return self.free["log", a[0]]
            case "log":  # a u' = a'
                rest = _derivative(a)[k - 1] - _product(_derivative(u), a[1:], k - 2)
                return rest * self._inverse(k * a[0])
            case "where" if a[0]:  # of a power's derivative: what is not 0 here is not 0 nearby
                return self[e.operands[1].order][k]
            case "pow" if e.operands[1].value in _POWERS:
                return self._multiplied(e.order, a, int(e.operands[1].value or 0), k)
            case "sqrt":
                return self._power(u, a, pow(2, -1, self.p), k)
            case "pow" if not any(b[1:]):
                return self._power(u, a, b[0], k)
        raise NotImplementedError(e.operation)

    def _multiplied(self, order: int, a: list[int], exponent: int, k: int) -> int:
        """Computes a coefficient of a^exponent, from those of the lower powers, which are kept."""
        powers = self.powers.setdefault(order, [[] for _ in range(1, exponent)])
        for lower, higher in itertools.pairwise([a, *powers]):
            higher.append(_product(lower, a, k) % self.p)
        return powers[-1][k]

    def _power(self, u: list[int], a: list[int], exponent: int, k: int) -> int:
        """Computes a coefficient of u = a^exponent, by a u' = exponent u a'."""
        inverse = self._inverse(max(k, 1) * a[0])
        if k == 0:
            return self.free.power(a[0], exponent)
        right = exponent * _product(_derivative(a), u, k - 1)
        return (right - _product(_derivative(u), a[1:], k - 2)) * inverse

    def _inverse(self, value: int) -> int:
        if value == 0:
            raise ZeroDivisionError
        return pow(value, -1, self.p)


def _product(a: Sequence[int], b: Sequence[int], k: int) -> int:
    """Computes coefficient k of a product of series: the sum of a_i b_(k - i)."""
    if k < 0:
        return 0
    return sum(map(operator.mul, a[: k + 1], b[k::-1]))


def _derivative(a: Sequence[int]) -> list[int]:
    return [i * v for i, v in enumerate(a)][1:]


def _modulo(value: float, prime: int) -> int:
    numerator, denominator = value.as_integer_ratio()
    return numerator * pow(denominator, -1, prime) % prime


class _Basis(dict[int, list[int]]):
    """Holds independent rows modulo a prime by their pivot columns; in each of these all other rows
    are 0."""

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
        if not factor:
            return row
        return [(v - factor * w) % self.p for v, w in zip(row, known, strict=True)]
