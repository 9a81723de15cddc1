"""Solves the affine models about paths: their states of least cost, and covariances.

Such a model has states x of epochs k = 0 ... K, with x[-1] = 0, unit noise w and readings v:

    x[k] = A[k] x[k-1] + a[k] + G[k] w[k],   |w|^2 + |v - B x|^2 + x' D x  least

with a diagonal D that damps. From the last epoch to the first, what its readings and later ones say
of a state, |Y' x - y|^2, is passed on to the state before by orthogonal rows (Dyer and McReynolds,
J. Optim. Theory Appl. 3, 1969): with C = (B', Y, D^1/2) and c = (v, y, 0)

    G' C      I        R  0
    A' C      0   ->   S  Y
    c - a' C  0        r  y

Given all readings and the state before, w = R'^-1 (r - S' x[k-1] + e) with e ~ N(0, I), so that

    x[k] = M x[k-1] + b + N e,   N = G R'^-1,   M = A - N S',   b = a + N r.

The pivots of R are 1 at least: G may be of any rank, and a prior however wide costs no digits. A
trial has the same bits in any batch.

Arrays of states hold 1 + K epochs, and those of what leads to a state or is read of it the K from
the second on: `A[:, k - 1]` leads to `x[:, k]`. `Step.run` lets the shorter ones lack their first
epoch, so that one number k counts in all of them. *Links* are the rows M, b, N of each epoch, and
the pivots of R.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, own
from ipe_bench.engine.scan import Step, gram, product
from ipe_bench.states.layouts import Layout, Shape, full, named_step, packed, triangle
from ipe_bench.states.steps import (
    Linear,
    Rows,
    State,
    Vector,
    beside,
    dot,
    lower,
    plus,
    unit,
    updated,
    zeros,
)

_NUMBERS = 5e5
"""Numbers of models that are held at once: they stay in a processor's cache."""
_LANES = 8
"""Trials at least that are held at once: machine code takes no more time for them than for one."""


@dataclass(frozen=True)
class Tangents:
    """Holds the affine model about paths."""

    A: Array
    """df/dx (trials, K, n, n)."""
    B: Array
    """R^-1/2 dh/dx (trials, K, m, n); 0 of missing readings."""


class Given(NamedTuple):
    """Holds what all readings say of the states of affine models."""

    covariance: Array
    """(trials, 1 + K, n, n)"""
    with_last: Array
    """Covariances (trials, 1 + K, n, n) of the states with the last ones."""
    log_determinant: Array
    """log det (trials,) of the Hessian of half the cost in w."""


@dataclass(frozen=True)
class Noise:
    """Holds roots of the covariances of noise, with which affine models are solved."""

    start: Array
    """Triangular (n, n), of the first states."""
    gains: Array
    """(K, n, q)"""

    def states(self, of: Tangents, a: Array, v: Array, damping: Array | None = None) -> Array:
        """Computes the states x (trials, 1 + K, n) of least cost for a (trials, 1 + K, n) and v
        (trials, K, m), with D = diag(damping (trials, 1 + K, n))."""
        given = of.A, of.B, a, v
        if damping is None or not damping.any():
            return self._states(of, *given)
        x = np.empty(a.shape)
        # An undamped trial has the same bits beside damped ones.
        damped = damping.any(axis=(1, 2))
        for some, more in ((~damped, ()), (damped, (np.sqrt(damping),))):
            if some.any():
                x[some] = self._states(of, *(part[some] for part in (*given, *more)))
        return x

    def _states(self, of: Tangents, *given: Array) -> Array:
        """Computes the states for A, B, a, v and, if they are damped, roots of D."""
        chain = self._chain_of(of, damped=len(given) > 4)
        given = tuple(map(own, given))
        x = np.empty(given[2].shape)
        for rows, links in self._pieces(chain, len(x)):
            begun = self._passed_back(chain, [part[rows] for part in given], links)
            states = x[rows]
            states[:, 0] = chain.first.part(begun, "x")
            chain.ahead.run(
                states[:, 0].copy(), [links], _NONE, states, first=1, by=1, count=len(self.gains)
            )
        return x

    def spread(self, of: Tangents) -> Given:
        """Computes what all readings say of the states."""
        trials, K, n, _ = of.A.shape
        chain = self._chain_of(of, damped=False)
        nothing = np.zeros((trials, 1 + K, n)), np.zeros(of.B.shape[:3])
        given = [own(part) for part in (of.A, of.B, *nothing)]
        P = np.empty((trials, 1 + K, n * n))
        with_last = np.empty(P.shape)
        size = np.empty(trials)
        for rows, links in self._pieces(chain, trials):
            begun = self._passed_back(chain, [part[rows] for part in given], links)
            P[rows, 0] = chain.first.part(begun, "covariance")
            F = chain.first.part(begun, "F").copy()
            chain.covariances.run(F, [links], _NONE, P[rows], first=1, by=1, count=K)
            last = np.tile(np.eye(n).ravel(), (len(links), 1))
            chain.crossed.run(
                last, [P[rows], links], _NONE, with_last[rows], first=K, by=-1, count=1 + K
            )
            size[rows] = np.log(chain.first.part(begun, "pivots")).sum(axis=1)
            size[rows] += np.log(chain.later.part(links[:, 1:], "pivots")).sum(axis=(1, 2))
        shape = trials, 1 + K, n, n
        return Given(P.reshape(shape), with_last.reshape(shape), 2 * size)

    def _passed_back(self, chain: _Chain, given: Sequence[Array], links: Array) -> Array:
        """Fills how states follow from those before (trials, 1 + K, t), from the second on, and
        returns what is said of the first (trials, s)."""
        trials, epochs, _ = links.shape
        start, gains = self._shared
        carry = np.zeros((trials, chain.carried.size))
        chain.back.run(carry, given, gains, links, first=epochs - 1, by=-1, count=epochs - 1)
        begun = np.empty((trials, 1, chain.first.size))
        _, _, a, _, *D = given
        chain.begin.run(carry, [a, *D], start, begun, first=0, by=1, count=1)
        return begun[:, 0]

    def blind_variances(self, of: Tangents) -> Array:
        """Computes the variances (trials, 1 + K, n) of states that nothing is read of."""
        return self._filtered(Tangents(of.A, np.zeros(of.B.shape)))[0]

    def doubt(self, of: Tangents, x: Array) -> Array:
        """Computes the largest variance (trials,) of what is read along paths x (trials, 1 + K, n)
        by the digits of a float, in parts of a reading's."""
        return self._filtered(of, x)[1]

    def _filtered(self, of: Tangents, x: Array | None = None) -> tuple[Array, Array]:
        """Returns the variances (trials, 1 + K, n) of states by the readings up to each epoch, and
        the doubt (trials,) in these."""
        trials, K, n, _ = of.A.shape
        variances = np.empty((trials, 1 + K, n))
        variances[:, 0] = np.sum(self.start**2, axis=1)
        x = np.zeros(variances.shape) if x is None else x
        carry = np.tile(np.append(packed(self.start), 0.0), (trials, 1))
        given = [own(part) for part in (of.A, of.B, x)]
        filtered = self._chain_of(of, damped=False).filter
        filtered.run(carry, given, self._shared[1], variances, first=1, by=1, count=K)
        return variances, carry[:, -1]

    def _pieces(self, chain: _Chain, trials: int) -> Iterator[tuple[slice, Array]]:
        """Yields trials that are held at once, with room for how their states follow (trials, 1 +
        K, t)."""
        size = chain.later.size
        epochs = 1 + len(self.gains)
        at_once = max(_LANES, int(_NUMBERS / (epochs * size)) // _LANES * _LANES)
        links = np.empty((min(trials, at_once), epochs, size))
        # Nothing leads to the first states, yet the pass of `crossed` reads a row there, too.
        links[:, 0] = 0.0
        for i in range(0, trials, at_once):
            rows = slice(i, min(i + at_once, trials))
            yield rows, links[: rows.stop - i]

    def _chain_of(self, of: Tangents, damped: bool) -> _Chain:
        return _made_chain(of.B.shape[2], *self._shapes, damped)

    @functools.cached_property
    def _patterns(self) -> tuple[Array, Array]:
        """Tells where the roots of some epoch are not 0."""
        return self.start != 0, (self.gains != 0).any(axis=0)

    @functools.cached_property
    def _shapes(self) -> tuple[Shape, Shape]:
        start, gains = self._patterns
        return _places(start), _places(gains)

    @functools.cached_property
    def _shared(self) -> tuple[Array, Array]:
        """Returns their numbers for the steps: of the first epoch, and of all."""
        first, later = self._patterns
        shared = np.zeros((1 + len(self.gains), np.count_nonzero(later)))
        shared[1:] = self.gains[:, later]
        return self.start[first][None], shared


_NONE = np.empty((0, 0))


def _places(some: Array) -> Shape:
    return tuple(map(tuple, some.tolist()))


class _Chain(NamedTuple):
    """Holds the steps along affine models, and layouts of what they take and give."""

    carried: Layout
    """What readings from an epoch on say of its states."""
    later: Layout
    """How states follow from those before."""
    first: Layout
    back: Step
    """Passes what readings say from an epoch to the one before."""
    begin: Step
    """Computes the first states."""
    ahead: Step
    """Computes states from those before."""
    covariances: Step
    """By all readings, from the first epoch on."""
    crossed: Step
    """Covariances with the last states, from the last epoch back."""
    filter: Step


@functools.lru_cache(maxsize=64)
def _made_chain(m: int, start: Shape, gains: Shape, damped: bool) -> _Chain:
    assert not isinstance(start, int)
    assert not isinstance(gains, int)
    n = len(gains)
    q = len(gains[0])
    square = full(n, n)
    given = [Layout(A=square), Layout(B=full(m, n)), Layout(a=n), Layout(v=m)]
    begun = [Layout(a=n)]
    if damped:
        given.append(Layout(D=n))
        begun.append(Layout(D=n))
    carried = Layout(Y=triangle(n), y=n)
    # A state that has no noise leaves a row of zeros.
    N = tuple((any(row),) * q for row in gains)
    follows: dict[str, Shape] = {"M": square, "b": n}
    later = Layout(**follows, N=N, pivots=q)
    first = Layout(x=n, F=triangle(n), covariance=square, pivots=n)
    covariance = Layout(covariance=square)
    nothing = Layout()
    root = Layout(F=triangle(n))
    filtered = Layout(F=triangle(n), doubt=1)
    shared = Layout(G=gains)

    def made(
        text: Any, carried: Layout, each: Sequence[Layout], shared: Layout, shown: Layout
    ) -> Step:
        return named_step(text, text.__name__, carried, each, shared, shown)

    of_root = Layout(**follows, N=N)
    return _Chain(
        carried,
        later,
        first,
        made(_step_back, carried, given, shared, later),
        made(_step_begin, carried, begun, Layout(G=start), first),
        made(_step_ahead, Layout(x=n), [Layout(**follows)], nothing, Layout(x=n)),
        made(_step_covariances, root, [of_root], nothing, covariance),
        made(
            _step_crossed,
            Layout(last=square),
            [covariance, Layout(M=square)],
            nothing,
            Layout(crossed=square),
        ),
        made(_step_filter, filtered, [*given[:2], Layout(x=n)], shared, Layout(variances=n)),
    )


def _turned(A: Rows) -> Rows:
    return [list(column) for column in zip(*A, strict=True)]


class _Eliminated(NamedTuple):
    """Holds how noise and states follow from the states before."""

    N: Rows
    S: Rows
    r: Vector
    pivots: Vector
    Y: Rows
    y: Vector


def _eliminated(A: Rows, a: Vector, G: Rows, C: Rows, c: Vector) -> _Eliminated:
    """Passes |C' x - c|^2 on from states x = A x[k-1] + a + G w to those before."""
    n = len(A[0])
    q = len(G[0])
    # W is the left side of the first equation above, whose last row is c - a' C, and L the right.
    left = [of - dot(a, column) for of, column in zip(c, _turned(C), strict=True)]
    W = beside(product(_turned(G), C), unit(q))
    W += beside([*product(_turned(A), C), left], zeros(n + 1, q))
    L = lower(W)
    R, S, r = ([row[:q] for row in rows] for rows in (L[:q], L[q:-1], L[-1:]))
    # N R' = G, column after column.
    N = []
    for gains in G:
        row: Vector = []
        for gain, above in zip(gains, R, strict=True):
            row.append((gain - dot(above, row)) * (1.0 / above[len(row)]))
        N.append(row)
    Y = [row[q : q + n] for row in L[q:-1]]
    return _Eliminated(N, S, r[0], [row[i] for i, row in enumerate(R)], Y, L[-1][q : q + n])


def _diagonal(D: Vector) -> Rows:
    return [[d if i == j else 0.0 for j in range(len(D))] for i, d in enumerate(D)]


def _step_back(
    Y: Rows, y: Vector, A: Rows, B: Rows, a: Vector, v: Vector, G: Rows, D: Vector | None = None
) -> dict[str, Any]:
    """Steps back from an epoch to the one before."""
    C = beside(_turned(B), Y)
    c = [*v, *y]
    if D:
        C = beside(C, _diagonal(D))
        c += [0.0] * len(D)
    N, S, r, pivots, Y, y = _eliminated(A, a, G, C, c)
    # Without noise a product with its slopes has no columns.
    moved = product(N, _turned(S)) if pivots else zeros(len(A), len(A))
    M = [
        [one - other for one, other in zip(*rows, strict=True)]
        for rows in zip(A, moved, strict=True)
    ]
    return {"Y": Y, "y": y, "M": M, "b": plus(a, N, r), "N": N, "pivots": pivots}


def _step_begin(Y: Rows, y: Vector, a: Vector, G: Rows, D: Vector | None = None) -> dict[str, Any]:
    """Computes the first states, which have none before."""
    C = Y
    c = y
    if D:
        C = beside(C, _diagonal(D))
        c = [*c, *[0.0] * len(D)]
    none: Rows = [[] for _ in Y]
    N, _, r, pivots, _, _ = _eliminated(none, a, G, C, c)
    F = lower(N)
    x = plus(a, N, r)
    return {"Y": Y, "y": y, "x": x, "F": F, "covariance": gram(F), "pivots": pivots}


def _step_ahead(x: Vector, M: Rows, b: Vector) -> dict[str, Any]:
    return {"x": plus(b, M, x)}


def _step_covariances(F: Rows, M: Rows, b: Vector, N: Rows) -> dict[str, Any]:
    """Computes covariances by all readings."""
    F = lower(beside(product(M, F), N))
    return {"F": F, "covariance": gram(F)}


def _step_crossed(last: Rows, covariance: Rows, M: Rows) -> dict[str, Any]:
    """Computes covariances with the last states."""
    return {"crossed": product(covariance, last), "last": product(_turned(M), last)}


def _step_filter(F: Rows, doubt: Vector, A: Rows, B: Rows, x: Vector, G: Rows) -> dict[str, Any]:
    """Takes in readings, and asks what floats keep of them."""
    m = len(B)
    F = lower(beside(product(A, F), G))
    nothing = [0.0] * m
    linear = Linear(nothing, product(B, F), [], B)
    found = updated(State(x, F), linear, unit(m), nothing, (), False)
    F = found.state.F
    most = np.maximum(doubt[0], found.doubt)
    return {"F": F, "doubt": [most], "variances": [dot(row, row) for row in F]}
