"""Computes what readings say of the states of an affine model, one epoch after another.

This is the square-root information filter, run backwards (Dyer and McReynolds, J. Optim. Theory
Appl. 3, 1969; Bierman, Factorization Methods for Discrete Sequential Estimation, 1977). For states

    x[k] = A x[k-1] + a + G w,   unit noise w, and readings v of B x with unit noise,

all that readings from epoch k on say of x[k] is a sum of squares, |Y' x - y|^2. `passed_back` adds
the noise w to it and eliminates x[k] and w: what is left is of x[k-1], and beside it stands how
x[k] follows from x[k-1] once all readings are known, x[k] = M x[k-1] + b + N e with e ~ N(0, I).
`begun` ends at the first states, and from there `gone_ahead` computes states, and `spread_ahead`
covariances. No covariance is inverted: pivots are 1 at least, so that G may be of any rank, and a
prior however wide costs no digits.

Each function here is recorded and runs in machine code; the layouts say which numbers it takes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ipe_bench.engine.scan import Step, gram, product
from ipe_bench.states.layouts import Layout, Shape, full, named_step, triangle
from ipe_bench.states.steps import (
    Linear,
    Readings,
    Rows,
    State,
    Vector,
    beside,
    dot,
    lower,
    plus,
    transposed,
    unit,
    updated,
    zeros,
)


class _Eliminated(NamedTuple):
    """Holds what is left of |C' x - c|^2 once x is eliminated."""

    Y: Rows
    y: Vector
    """|Y' x[k-1] - y|^2 is what is said of the states before."""
    N: Rows
    S: Rows
    r: Vector
    """w = R'^-1 (r - S' x[k-1] + e) with e ~ N(0, I), and N = G R'^-1."""
    pivots: Vector
    """Of R."""


def _eliminated(A: Rows, a: Vector, G: Rows, C: Rows, c: Vector) -> _Eliminated:
    """Passes |C' x - c|^2 on from states x = A x[k-1] + a + G w to those before.

    Orthogonal rows make of the equations of w, x[k-1] and the right side

        G' C      I        R  0
        A' C      0   ->   S  Y
        c - a' C  0        r  y
    """
    n = len(A[0])
    q = len(G[0])
    right = [of - dot(a, column) for of, column in zip(c, transposed(C), strict=True)]
    of_noise = beside(product(transposed(G), C), unit(q))
    of_states = beside([*product(transposed(A), C), right], zeros(n + 1, q))
    L = lower([*of_noise, *of_states])
    R = [row[:q] for row in L[:q]]
    S = [row[:q] for row in L[q:-1]]
    r = L[-1][:q]
    Y = [row[q : q + n] for row in L[q:-1]]
    y = L[-1][q : q + n]
    pivots = [row[i] for i, row in enumerate(R)]
    return _Eliminated(Y, y, _divided(G, R), S, r, pivots)


def _divided(G: Rows, R: Rows) -> Rows:
    """Computes N of N R' = G, for a triangular R, column after column."""
    N = []
    for gains in G:
        row: Vector = []
        for gain, above in zip(gains, R, strict=True):
            row.append((gain - dot(above, row)) * (1.0 / above[len(row)]))
        N.append(row)
    return N


def _damped(C: Rows, c: Vector, D: Vector | None) -> tuple[Rows, Vector]:
    """Adds x' diag(D)^2 x, which draws states to 0, to |C' x - c|^2."""
    if not D:
        return C, c
    diagonal = [[d if i == j else 0.0 for j in range(len(D))] for i, d in enumerate(D)]
    return beside(C, diagonal), [*c, *[0.0] * len(D)]


def passed_back(
    Y: Rows, y: Vector, A: Rows, B: Rows, a: Vector, v: Vector, G: Rows, D: Vector | None = None
) -> dict[str, Any]:
    """Takes in the readings of an epoch, and steps back to the one before."""
    C, c = _damped(beside(transposed(B), Y), [*v, *y], D)
    left = _eliminated(A, a, G, C, c)
    # Without noise a product with its slopes has no columns.
    moved = zeros(len(A), len(A))
    if left.pivots:
        moved = product(left.N, transposed(left.S))
    # M = A - N S' and b = a + N r.
    M = [
        [one - other for one, other in zip(row, by, strict=True)]
        for row, by in zip(A, moved, strict=True)
    ]
    b = plus(a, left.N, left.r)
    return {"Y": left.Y, "y": left.y, "M": M, "b": b, "N": left.N, "pivots": left.pivots}


def begun(Y: Rows, y: Vector, a: Vector, G: Rows, D: Vector | None = None) -> dict[str, Any]:
    """Computes the first states, which have none before."""
    C, c = _damped(Y, y, D)
    none: Rows = [[] for _ in Y]
    left = _eliminated(none, a, G, C, c)
    F = lower(left.N)
    x = plus(a, left.N, left.r)
    # Y and y are carried on unchanged: nothing comes after this.
    return {"Y": Y, "y": y, "x": x, "F": F, "covariance": gram(F), "pivots": left.pivots}


def gone_ahead(x: Vector, M: Rows, b: Vector) -> dict[str, Any]:
    """Computes the states from those before."""
    return {"x": plus(b, M, x)}


def spread_ahead(F: Rows, M: Rows, b: Vector, N: Rows) -> dict[str, Any]:
    """Computes covariances by all readings from those before."""
    F = lower(beside(product(M, F), N))
    return {"F": F, "covariance": gram(F)}


def crossed_back(last: Rows, covariance: Rows, M: Rows) -> dict[str, Any]:
    """Computes covariances with the last states; `last` is the product of all M from here to
    them."""
    return {"crossed": product(covariance, last), "last": product(transposed(M), last)}


def filtered(F: Rows, doubt: Vector, A: Rows, B: Rows, x: Vector, G: Rows) -> dict[str, Any]:
    """Takes in readings as a filter does, and asks what floats keep of them."""
    m = len(B)
    F = lower(beside(product(A, F), G))
    nothing = [0.0] * m
    linear = Linear(nothing, product(B, F), [], B)
    found = updated(State(x, F), linear, unit(m), Readings(nothing, (), False))
    F = found.state.F
    most = np.maximum(doubt[0], found.doubt)
    return {"F": F, "doubt": [most], "variances": [dot(row, row) for row in F]}


class Steps(NamedTuple):
    """Holds these functions as steps of machine code, and the layouts of what they leave."""

    said: Layout
    """What readings from an epoch on say of its states: Y, y."""
    follows: Layout
    """How states follow from those before: M, b, N, and the pivots of R."""
    first: Layout
    """What is left at the first epoch."""
    back: Step
    begin: Step
    ahead: Step
    covariances: Step
    crossed: Step
    filter: Step


@functools.lru_cache(maxsize=64)
def steps_of(m: int, start: Shape, gains: Shape, damped: bool) -> Steps:
    """Makes the steps of models with m readings an epoch, by where the roots of noise are not
    0."""
    assert not isinstance(start, int)
    assert not isinstance(gains, int)
    n = len(gains)
    q = len(gains[0])
    square = full(n, n)
    A = Layout(A=square)
    B = Layout(B=full(m, n))
    a = Layout(a=n)
    D = [Layout(D=n)] if damped else []
    G = Layout(G=gains)
    nothing = Layout()
    # A state that has no noise leaves a row of zeros.
    N = tuple((any(row),) * q for row in gains)
    said = Layout(Y=triangle(n), y=n)
    follows = Layout(M=square, b=n, N=N, pivots=q)
    first = Layout(x=n, F=triangle(n), covariance=square, pivots=n)
    covariance = Layout(covariance=square)

    def made(
        function: Callable[..., Any],
        carried: Layout,
        each: Sequence[Layout],
        shared: Layout,
        shown: Layout,
    ) -> Step:
        return named_step(function, function.__name__, carried, each, shared, shown)

    # A step takes the first numbers of a row of `follows`: M and b alone, or N, too.
    return Steps(
        said,
        follows,
        first,
        back=made(passed_back, said, [A, B, a, Layout(v=m), *D], G, follows),
        begin=made(begun, said, [a, *D], Layout(G=start), first),
        ahead=made(gone_ahead, Layout(x=n), [Layout(M=square, b=n)], nothing, Layout(x=n)),
        covariances=made(
            spread_ahead,
            Layout(F=triangle(n)),
            [Layout(M=square, b=n, N=N)],
            nothing,
            covariance,
        ),
        crossed=made(
            crossed_back,
            Layout(last=square),
            [covariance, Layout(M=square)],
            nothing,
            Layout(crossed=square),
        ),
        filter=made(
            filtered,
            Layout(F=triangle(n), doubt=1),
            [A, B, Layout(x=n)],
            G,
            Layout(variances=n),
        ),
    )
