"""Steps of Gaussian filters and smoothers of one trial at one epoch.

Vectors and matrices are lists of numbers. Run on unknowns the steps leave a program for
`engine.scan`, run on numbers they are its reference. So conditions are `where`, a missing reading
is a row of zeros, and loops have fixed lengths.

Any number that is normal is written by independent unit noises v ~ N(0, I): states are x + F v,
with a triangular F, so that F F' is their covariance. A step puts the rows of all numbers that
matter below each other, and takes them by orthogonal rows to a triangular form, which leaves the
covariances as they are (Bierman, Factorization Methods for Discrete Sequential Estimation, 1977);
nothing is inverted, and nothing subtracted from a covariance:

    predict   (A F, N)            ->  (F-, 0)            x- = A x + b,  N N' = Q + W
    update    (M, H F; 0, F-)     ->  (L, 0; X, F+)      x+ = x- + X e,  L e = y,  M M' = R + W

W is the covariance of what a linearisation leaves of f or h. Rows (0, I) below these, of the old
unit noise v itself, become what it is by the new one, which is all that a smoother takes.

An example: a state x- = 0 with the deviation F- = 4 and a reading z = x + v = 5, whose noise has
the deviation M = 3. The first row has the length 5, and becomes the first axis; the second has
3.2 along it and 2.4 across it:

    (3, 4)   ->   (5,   0)         L = 5,    e = 5 / 5 = 1
    (0, 4)        (3.2, 2.4)       X = 3.2,  F+ = 2.4,  x+ = 0 + 3.2 e = 3.2

So says the Kalman gain, too: X / L = 0.64 = 16 / (16 + 9), and F+^2 = 5.76 = 16 (1 - 0.64).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import add, mul
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from ipe_bench.engine.scan import dot, orthogonalised, product
from ipe_bench.states.student import Mixture, evidence

_SMALL = 1e-14
"""Part of a row's length, or of a pivot's row, that is round-off."""
_HIDDEN = 0.01
"""Square of the part of a state that counts beside its deviation: half a unit in the last place of
the state is lost, one of the covariance in each step."""
BEYOND = 1e25
"""Doubt of an update above which round-off counts beside what readings leave."""

Number: TypeAlias = Any
"""A float, an array of them or an expression."""
Vector: TypeAlias = "list[Number]"
Rows: TypeAlias = "list[list[Number]]"


class Function(Protocol):
    """f or h of an epoch."""

    @property
    def periods(self) -> Sequence[float]: ...

    def __call__(self, x: Vector) -> Vector: ...

    def slopes(self, x: Vector) -> tuple[Vector, Rows]:
        """Computes values (m) and slopes (m, n)."""
        ...


class State(NamedTuple):
    """Holds N(x, F F')."""

    x: Vector
    F: Rows


class Linear(NamedTuple):
    """Holds y = A x + b + e about a state."""

    y: Vector
    """A x + b"""
    AF: Rows
    residuals: Rows
    """What the rule leaves of each value at its points, whose covariance is W."""
    A: Rows


class Law(Protocol):
    """A rule that linearises functions, in lists."""

    def __call__(self, g: Function, state: State, at: State) -> Linear:
        """Linearises g about the states `at`, and takes it at `state`."""
        ...

    def noise(self, N: Rows, linear: Linear) -> Rows:
        """Returns a root of N N' + W."""
        ...


class Tangent:
    """Linearises by the tangent at a mean."""

    def __call__(self, g: Function, state: State, at: State) -> Linear:
        y, A = g.slopes(at.x)
        return _taken_at(state, at, Linear(y, [], [[] for _ in y], A))

    def noise(self, N: Rows, linear: Linear) -> Rows:
        return N


class Regression(NamedTuple):
    """Linearises by statistical regression on points of the standard normal distribution."""

    s: Rows
    """(p, n)"""
    w: Vector
    """Weights (p) in means."""
    c: Vector
    """Weights (p) in covariances."""

    def __call__(self, g: Function, state: State, at: State) -> Linear:
        # A row for each of the values of g, with its numbers at the points.
        values = transposed(self._values(g, at))
        mean = [dot(self.w, row) for row in values]
        off = [[a - middle for a in row] for row, middle in zip(values, mean, strict=True)]
        # The covariance of values and points is A F, since that of points is I.
        weighted = [[*map(mul, self.c, row)] for row in off]
        across = transposed(self.s)
        AF = [[dot(row, along) for along in across] for row in weighted]
        residuals = []
        for row, slopes in zip(off, AF, strict=True):
            residuals.append([a - dot(slopes, s) for a, s in zip(row, self.s, strict=True)])
        linear = Linear(mean, AF, residuals, over(AF, at.F))
        return linear if at is state else _taken_at(state, at, linear)

    def noise(self, N: Rows, linear: Linear) -> Rows:
        residuals = linear.residuals
        if min(self.c) >= 0:
            deviations = np.sqrt(self.c)
            return beside(N, [[*map(mul, deviations, row)] for row in residuals])
        # A negative weight leaves a difference, which has no root of its own.
        each = zip(residuals, linear.AF, linear.y, strict=True)
        residuals = [self._unless_rounded(*one) for one in each]
        weighted = [[*map(mul, self.c, row)] for row in residuals]
        W = []
        for own, row in zip(N, weighted, strict=True):
            pairs = zip(N, residuals, strict=True)
            W.append([dot(own, noise, dot(row, other)) for noise, other in pairs])
        return root(W)

    def _values(self, g: Function, at: State) -> Rows:
        """Computes g at the points (p, m)."""
        values = [g(plus(at.x, at.F, point)) for point in self.s]
        if not any(g.periods):
            return values
        # The mean of points on both sides of a jump would lie opposite.
        center = g(at.x)
        return [near(y, center, g.periods) for y in values]

    def _unless_rounded(self, residuals: Vector, AF: Vector, y: Number) -> Vector:
        """Returns what is left of a value, or 0 where that is round-off."""
        squares = [a * a for a in residuals]
        sizes = [abs(one) for one in self.c]
        rounded = _SMALL**2 * sum(sizes) * dot(AF, AF, y * y)
        least = _SMALL * dot(sizes, squares) + rounded
        none = np.less_equal(np.abs(dot(self.c, squares)), least)
        return [np.where(none, 0.0, a) for a in residuals]


def _taken_at(state: State, at: State, linear: Linear) -> Linear:
    """Returns a law about the states `at`, taken at others."""
    apart = [a - b for a, b in zip(state.x, at.x, strict=True)]
    y = plus(linear.y, linear.A, apart)
    return linear._replace(y=y, AF=product(linear.A, state.F))


def predicted(linear: Linear, N: Rows, smooths: bool) -> tuple[State, Rows]:
    """Returns the states after a transition with noise of the root N, and for a smoother rows
    (X, Y): the old unit noise is X times the new one, and Y times another."""
    n = len(N)
    W = beside(linear.AF, N)
    if smooths:
        W += beside(unit(n), zeros(n, len(N[0])))
    both = lower(W, n)
    F = [row[:n] for row in both[:n]]
    return State(linear.y, F), both[n:]


class Readings(NamedTuple):
    """Holds the readings of an epoch, and how they are taken in."""

    z: Vector
    """(m), NaN where missing"""
    periods: Sequence[float]
    """The period of each, or 0; empty if none has one."""
    smooths: bool
    """Whether a smoother follows, which takes rows of the update."""
    variances: Sequence[Number] = ()
    """R of each, if their noise has tails."""
    tails: Sequence[Mixture] = ()
    """The mixture of normal distributions that the noise of each is; empty if all are normal."""

    def within(self, linear: Linear, M: Rows, most: float) -> Readings:
        """Returns the readings with those missing whose squared innovation exceeds its variance by
        more than a factor `most`. With tails M is that of the least noise, which says little of how
        far away readings lie: a run refuses a gate beside tails."""
        kept = []
        y = near(linear.y, self.z, self.periods)
        for reading, a, noise, slopes in zip(self.z, y, M, linear.AF, strict=True):
            apart = reading - a
            variance = dot(noise, noise, dot(slopes, slopes))
            # What is not a number lies beyond nothing: h has no value there, and the trial is lost.
            beyond = np.less(most * variance, apart * apart)
            kept.append(np.where(beyond, np.nan, reading))
        return self._replace(z=kept)


class Update(NamedTuple):
    """Holds the states after readings, and what these say."""

    state: State
    e: Vector
    """Normalised innovations (m), 0 of missing readings."""
    L: Rows
    """L L' is the covariance of innovations; rows of 0 of missing readings."""
    doubt: Number
    """The largest variance of what is read by the digits of a float, in parts of a reading's."""
    unit_noise_rows: Rows
    """For a smoother rows (X, Y): the old unit noise is X e, and Y times the new one. Other noise
    is left of it in columns that the root of the states has not."""
    by_mixture: dict[str, Sequence[Number]]
    """Of readings with tails, which have no L, five numbers each (m,); empty if all are normal.
    Before any reading of the epoch: `predicted`, what the reading is expected to be; `deviation`,
    the standard deviation of its innovation. After the readings in front of it: `apart`, its
    innovation; `others`, the variance of that if the reading has its least noise; `own`, the
    variance R of the reading."""


def updated(state: State, linear: Linear, M: Rows, readings: Readings) -> Update:
    """Takes in readings with noise of the root M; if that has tails, M is a root of its least
    normal distributions."""
    if readings.tails:
        return _updated_one_by_one(state, linear, M, readings)
    m = len(M)
    n = len(state.x)
    seen, y, W, doubt = _prepared(state, linear, M, readings)
    both = lower(W, m + n)
    L = [row[:m] for row in both[:m]]
    e: Vector = []
    for i, (there, row) in enumerate(zip(seen, L, strict=True)):
        # Of a reading that others or the states give exactly, row[i] is 0: e is no number, and the
        # trial is lost. Models with a reading that has no noise are refused before.
        rest = y[i] - dot(row[:i], e)
        e.append(np.where(there, rest, 0.0) / np.where(there, row[i], 1.0))
    of_states = both[m : m + n]
    x = plus(state.x, [row[:m] for row in of_states], e)
    F = [row[m : m + n] for row in of_states]
    unit_noise_rows = [row[: m + n] for row in both[m + n :]]
    return Update(State(x, F), e, L, doubt, unit_noise_rows, {})


def least_noise(R: Rows, tails: Sequence[Mixture]) -> Rows:
    """Returns a root of the least noise of readings whose noise has the root R."""
    pairs = zip(R, tails, strict=True)
    return [[np.sqrt(one.least) * a for a in row] for row, one in pairs]


def _updated_one_by_one(state: State, linear: Linear, M: Rows, readings: Readings) -> Update:
    """Takes in readings one after another whose noise is a mixture each.

    After each the states have the mean and the covariance of all normal distributions that they
    are by then. A row then is less by its covariance with the innovation, and has one more column,
    which keeps its variance: what the noise of the reading hides, and how far apart the means are.
    """
    m = len(M)
    n = len(state.x)
    seen, y, rows, doubt = _prepared(state, linear, M, readings)
    by_mixture = _predicted_by_mixtures(y, rows, readings)
    e: Vector = []
    others: Vector = []
    # How the number of each row moves with the innovations so far.
    X: Rows = [[] for _ in rows]
    for j in range(m):
        # Reading j is taken off the rows, X keeps them all: rows[i] is that of X[j + 1 + i].
        reading, *rows = rows
        variance = np.where(seen[j], dot(reading, reading), 1.0)
        others.append(variance)
        found = evidence(y[j], variance, readings.variances[j], readings.tails[j])
        by_e = np.sqrt(found.gain)
        e.append(y[j] * by_e)
        hidden = np.sqrt(found.left)
        for i, row in enumerate(rows):
            share = dot(row, reading)
            kept = [a - share * found.gain * b for a, b in zip(row, reading, strict=True)]
            rows[i] = [*kept, share * hidden]
            X[j + 1 + i].append(share * by_e)
        for i in range(j + 1, m):
            y[i] = y[i] - X[i][j] * e[j]
    # Rows of the readings are gone: those of the states are in front.
    both = lower(rows)
    x = plus(state.x, X[m : m + n], e)
    F = [row[:n] for row in both[:n]]
    by_mixture |= {"apart": y, "others": others, "own": readings.variances}
    unit_noise_rows: Rows = []
    if readings.smooths:
        unit_noise_rows = beside(X[m + n :], [row[:n] for row in both[n:]])
    # L = I stands for none: the likelihood of mixtures is that of `by_mixture`.
    return Update(State(x, F), e, unit(m), doubt, unit_noise_rows, by_mixture)


def _predicted_by_mixtures(
    y: Vector, rows: Rows, readings: Readings
) -> dict[str, Sequence[Number]]:
    """Returns the readings with tails that are predicted, and the deviations of innovations y."""
    deviations = []
    # The rows go on with those of the states.
    for R, tail, row in zip(readings.variances, readings.tails, rows, strict=False):
        deviations.append(np.sqrt(dot(row, row, (1 - tail.least) * R)))
    expected = [a - b for a, b in zip(readings.z, y, strict=True)]
    return {"predicted": expected, "deviation": deviations}


class _Prepared(NamedTuple):
    """Holds what readings say before they are taken in."""

    seen: Vector
    """Whether each is there."""
    y: Vector
    """Innovations, 0 of missing readings."""
    W: Rows
    """Rows of readings by their noise and the states' unit noise, 0 of missing ones, above those of
    the states, and for a smoother of the unit noise itself."""
    doubt: Number


def _prepared(state: State, linear: Linear, M: Rows, readings: Readings) -> _Prepared:
    n = len(state.x)
    columns = len(M[0])
    seen = [np.less_equal(a, a) for a in readings.z]
    expected = near(linear.y, readings.z, readings.periods)
    y = []
    read = []
    rows = beside(M, linear.AF)
    for there, a, b, row in zip(seen, readings.z, expected, rows, strict=True):
        y.append(np.where(there, a - b, 0.0))
        read.append([np.where(there, one, 0.0) for one in row])
    W = read + beside(zeros(n, columns), state.F)
    if readings.smooths:
        W += beside(zeros(n, columns), unit(n))
    noise = [row[:columns] for row in read]
    return _Prepared(seen, y, W, _doubt(state, linear.A, noise))


def _doubt(state: State, H: Rows, M: Rows) -> Number:
    """Compares the variance of states, as readings of slopes H see it, with that of their noise of
    the root M: `Update.doubt`."""
    sizes = []
    for x, row in zip(state.x, state.F, strict=True):
        sizes.append(np.maximum(dot(row, row), _HIDDEN * (x * x)))
    most: Number = 0.0
    for slopes, noise in zip(H, M, strict=True):
        read = dot([a * a for a in slopes], sizes)
        own = dot(noise, noise)
        # A missing reading has a row of zeros; one without noise is refused with its model.
        none = np.less_equal(own, 0.0)
        most = np.maximum(most, np.where(none, 0.0, read) / np.where(none, 1.0, own))
    return most


def scores(e: Vector, L: Rows) -> tuple[Number, Number]:
    """Computes the NIS and the log likelihood of normalised innovations."""
    nis = dot(e, e)
    pivots = [row[i] for i, row in enumerate(L)]
    sizes = [np.where(np.less_equal(one, 0.0), 1.0, 2 * np.pi * one * one) for one in pivots]
    return nis, -0.5 * reduce(add, map(np.log, sizes), nis)


class Smoothed(NamedTuple):
    """Holds states x + F (u + S w), w ~ N(0, I), given all readings, of those x + F v with
    v ~ N(0, I) that a filter has."""

    u: Vector
    S: Rows

    def of(self, state: State) -> State:
        return State(plus(state.x, state.F, self.u), lower(product(state.F, self.S)))

    def before(self, e: Vector, read: Rows, moved: Rows) -> Smoothed:
        """Returns the same of the epoch before, by what an update and a transition told."""
        m = len(e)
        n = len(self.u)
        u = plus([0.0] * n, read, [*e, *self.u])
        S = lower(product([row[m:] for row in read], self.S))
        X = [row[:n] for row in moved]
        Y = [row[n:] for row in moved]
        return Smoothed(plus([0.0] * n, X, u), lower(beside(product(X, S), Y)))


def near(y: Vector, to: Vector, periods: Sequence[float]) -> Vector:
    """Shifts values by whole periods next to others."""
    if not any(periods):
        return y
    shifted = []
    for a, b, period in zip(y, to, periods, strict=True):
        shifted.append(a - period * np.floor((a - b) / period + 0.5) if period else a)
    return shifted


def plus(x: Sequence[Number], A: Rows, u: Sequence[Number]) -> Vector:
    """Computes x + A u."""
    return [dot(row, u, start) for start, row in zip(x, A, strict=True)]


def beside(*blocks: Rows) -> Rows:
    """Puts matrices side by side."""
    return [[a for row in rows for a in row] for rows in zip(*blocks, strict=True)]


def transposed(A: Rows) -> Rows:
    return [list(column) for column in zip(*A, strict=True)]


def zeros(rows: int, columns: int) -> Rows:
    return [[0.0] * columns for _ in range(rows)]


def unit(n: int) -> Rows:
    return [[float(i == j) for j in range(n)] for i in range(n)]


def lower(W: Rows, checked: int = 0) -> Rows:
    """Computes the triangular F with F F' = W W', by orthogonal rows (modified Gram and Schmidt);
    of the first `checked` rows, those that the rows above give but for round-off become 0."""
    return orthogonalised(W, checked, _SMALL)


def over(X: Rows, F: Rows) -> Rows:
    """Computes X F^-1 for a triangular F; pivots that are round-off count for nothing."""
    n = len(F)
    out = zeros(len(X), n)
    for j in reversed(range(n)):
        pivot = F[j][j]
        none = np.less_equal(pivot * pivot, _SMALL**2 * dot(F[j], F[j]))
        inverse = np.where(none, 0.0, 1.0) / np.where(none, 1.0, pivot)
        below = [F[k][j] for k in range(j + 1, n)]
        for x, found in zip(X, out, strict=True):
            found[j] = (x[j] - dot(found[j + 1 :], below)) * inverse
    return out


def root(W: Rows) -> Rows:
    """Computes a triangular root of a covariance W by Cholesky's way, with columns of 0 where a
    pivot is round-off beside the variance; not a number if W is indefinite."""
    n = len(W)
    F = zeros(n, n)
    for j in range(n):
        square = W[j][j] - dot(F[j][:j], F[j][:j])
        least = _SMALL * np.maximum(W[j][j], 0.0)
        some = np.less(least, square)
        none = np.less_equal(-least, square)
        length = np.sqrt(np.where(some, square, 1.0))
        inverse = np.where(some, 1.0, 0.0) / length
        F[j][j] = np.where(some, length, np.where(none, 0.0, np.nan))
        for i in range(j + 1, n):
            F[i][j] = (W[i][j] - dot(F[i][:j], F[j][:j])) * inverse
    return F
