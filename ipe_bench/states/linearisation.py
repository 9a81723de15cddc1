"""Rules that replace y = g(x), x ~ N(m, P), by y = A x + b + e, e ~ N(0, W): the one thing in which
Gaussian filters differ.

Taylor's rule gives the extended Kalman filter; statistical linear regression by sigma points gives
the unscented, cubature and Gauss-Hermite filters and, about the posterior, those of posterior
linearisation.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, multiply, own
from ipe_bench.basics.options import Component, Count, Finite, Positive
from ipe_bench.engine.scan import Step, dot
from ipe_bench.functions.complex_steps import by_complex_steps
from ipe_bench.states.algebra import half, over, transposed, triangular
from ipe_bench.states.layouts import Layout, full, named_step, packed, triangle
from ipe_bench.states.steps import plus

_MOST_POINTS = 100_000
"""Points of a product rule at most."""
_ROUND_OFF = 1e-14
"""Part of a number that is round-off of a sum over points."""
_FEW = 64
"""Points up to which NumPy is fast, and what they leave is a root of noise."""
Function = Callable[[Array], Array]
Nearest = Callable[[Array, Array], Array]


class Affine(NamedTuple):
    """y = A x + b + e with e ~ N(0, W), per trial."""

    A: Array
    """(trials, m, n)"""
    b: Array
    """(trials, m)"""
    W: Array
    """(trials, m, m)"""


class Linearised(NamedTuple):
    """Holds such a law about N(m, F F'), by its mean and by roots."""

    y: Array
    """A m + b (trials, m)"""
    AF: Array
    """(trials, m, n)"""
    W: Array
    """(trials, m, m)"""
    root: Array | None = None
    """A root (trials, m, r) of W, where the rule knows one."""
    A: Array | None = None
    """Slopes (trials, m, n), where the rule knows them."""

    def slopes(self, F: Array) -> Array:
        return over(self.AF, F) if self.A is None else self.A

    def noise_root(self, N: Array) -> Array:
        """Returns a root (trials, m, r) of N N' + W, for N (m, q) or (trials, m, q)."""
        each = np.broadcast_to(N, (*self.y.shape, N.shape[-1]))
        if self.root is None:
            W = np.matmul(each, transposed(each)) + self.W
            return half(W).G
        return np.concatenate([each, self.root], axis=2)


class Rule(Component, ABC):
    """A way to linearise a function about a normal distribution."""

    def linearise(self, g: Function, m: Array, P: Array, nearest: Nearest | None = None) -> Affine:
        """Computes the affine law of g about N(m, P), for m (trials, n) and P (trials, n, n).
        `nearest` shifts values of g that are periodic next to others: the mean of points on both
        sides of a bearing's jump would lie opposite."""
        F = triangular(P)
        law = self.linearised(g, m, F, nearest)
        A = law.slopes(F)
        return Affine(A, law.y - multiply(A, m), law.W)

    @abstractmethod
    def linearised(
        self, g: Function, m: Array, F: Array, nearest: Nearest | None = None
    ) -> Linearised:
        """Computes the affine law of g about N(m, F F') for triangular F (trials, n, n)
        likewise."""

    def mean(self, g: Function, m: Array, F: Array) -> Array:
        """Computes the mean (trials, ...) of g over N(m, F F'), g (trials, p, ...) at points
        (trials, p, n)."""
        return g(m)

    @abstractmethod
    def calls(self, n: int, periodic: bool = False) -> int:
        """Evaluations of g per trial, a slope in one direction counted as one; `periodic` where
        values are shifted."""


@dataclass(frozen=True)
class Taylor(Rule):
    """The tangent at the mean.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> table = ib.run(model, {"ekf": ib.states.Filter(rule=ib.states.Taylor())}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    def linearised(
        self, g: Function, m: Array, F: Array, nearest: Nearest | None = None
    ) -> Linearised:
        y, J = slope(g, m)
        W = np.zeros((*y.shape, y.shape[-1]))
        return Linearised(y, np.matmul(J, F), W, W[..., :0], J)

    def calls(self, n: int, periodic: bool = False) -> int:
        return 1 + n


@dataclass(frozen=True)
class SigmaPoints(Rule):
    """Statistical linear regression by points s and weights w of the standard normal distribution,
    with sum w s s' = I (Arasaratnam, Haykin, Elliott, Proc. IEEE 95, 2007)."""

    @abstractmethod
    def points(self, n: int) -> tuple[Array, Array]:
        """Returns points (p, n) and their weights (p,) in means."""

    def covariance_weights(self, w: Array) -> Array:
        """Returns the points' weights (p,) in covariances."""
        return w

    def linearised(
        self, g: Function, m: Array, F: Array, nearest: Nearest | None = None
    ) -> Linearised:
        s, w, c = self.weighted(m.shape[-1])
        y = g(_spread(m, F, s))
        if nearest is not None:
            y = nearest(y, g(m)[..., None, :])
        mean = np.matmul(w, y)
        if len(w) > _FEW:
            return Linearised(mean, *_regressed(own(y), mean, s, c))
        d = transposed(y - mean[..., None, :])
        M = np.matmul(c * d, s)
        left = d - np.matmul(M, s.T)
        W = np.matmul(c * left, transposed(left))
        if (c < 0).any():
            # A difference of squares may be round-off, below 0 too.
            least = _ROUND_OFF * np.matmul(left**2, np.abs(c))
            least += _ROUND_OFF**2 * np.abs(c).sum() * (np.sum(M**2, axis=2) + mean**2)
            none = np.abs(np.diagonal(W, axis1=1, axis2=2)) <= least
            W = np.where(none[:, None] | none[..., None], 0.0, W)
        # What is left is a root itself; of a negative weight there is none.
        root = None if (c < 0).any() else np.sqrt(c) * left
        return Linearised(mean, M, W, root)

    def mean(self, g: Function, m: Array, F: Array) -> Array:
        s, w, _ = self.weighted(m.shape[-1])
        values = g(_spread(m, F, s))
        return np.sum(w[:, None, None] * values, axis=-3)

    def calls(self, n: int, periodic: bool = False) -> int:
        return len(self.points(n)[1]) + periodic

    def weighted(self, n: int) -> tuple[Array, Array, Array]:
        """Returns points (p, n) with their weights (p,) in means and in covariances."""
        return _weighted(self, n)


@functools.lru_cache(maxsize=64)
def _weighted(rule: SigmaPoints, n: int) -> tuple[Array, Array, Array]:
    s, w = map(own, rule.points(n))
    return s, w, own(rule.covariance_weights(w))


def _spread(m: Array, F: Array, s: Array) -> Array:
    """Returns the points m + F s (trials, p, n); many of them in a scan along these."""
    if len(s) <= _FEW:
        return m[..., None, :] + np.matmul(s, transposed(F))
    trials, n = m.shape
    states = Layout(x=n, F=triangle(n))
    at = Layout(s=n)
    step = _along_points(_spread_step, states, (), at, Layout(y=n))
    carry = np.concatenate([m, packed(F)], axis=1)
    points = np.empty((trials, *s.shape))
    step.run(carry, [], s, points, 0, 1, len(s))
    return points


def _spread_step(x: Any, F: Any, s: Any) -> dict[str, Any]:
    return {"x": x, "F": F, "y": plus(x, F, s)}


def _regressed(y: Array, mean: Array, s: Array, c: Array) -> tuple[Array, Array]:
    """Returns M = A F (trials, m, n) and W (trials, m, m) of values y (trials, p, m) at points, in
    two scans along these: with d = y - mean,

    M = sum c d s',   W = sum c (d - M s) (d - M s)',

    which is no difference of large covariances."""
    trials, points, m = y.shape
    n = s.shape[1]
    values = Layout(y=m)
    at = Layout(s=n, c=1)
    weighted = np.concatenate([s, c[:, None]], axis=1)
    sums = Layout(mean=m, M=full(m, n))
    carry = np.concatenate([mean, np.zeros((trials, m * n))], axis=1)
    out = np.empty((trials, points, 0))
    step = _along_points(_slopes_step, sums, (values,), at, _NOTHING)
    step.run(carry, [y], weighted, out, 0, 1, points)
    M = sums.part(carry, "M", m, n)
    rest = Layout(**sums.shapes, W=full(m, m))
    carry = np.concatenate([carry, np.zeros((trials, m * m))], axis=1)
    step = _along_points(_rest_step, rest, (values,), at, _NOTHING)
    step.run(carry, [y], weighted, out, 0, 1, points)
    return M, rest.part(carry, "W", m, m)


def _slopes_step(mean: Any, M: Any, y: Any, s: Any, c: Any) -> dict[str, Any]:
    d = [c[0] * (a - middle) for a, middle in zip(y, mean, strict=True)]
    rows = zip(M, d, strict=True)
    return {
        "mean": mean,
        "M": [[a + b * e for a, e in zip(row, s, strict=True)] for row, b in rows],
    }


def _rest_step(mean: Any, M: Any, W: Any, y: Any, s: Any, c: Any) -> dict[str, Any]:
    off = [a - middle for a, middle in zip(y, mean, strict=True)]
    left = [d - dot(row, s) for d, row in zip(off, M, strict=True)]
    rows = zip(W, left, strict=True)
    moved = [[a + c[0] * b * e for a, e in zip(row, left, strict=True)] for row, b in rows]
    return {"mean": mean, "M": M, "W": moved}


@functools.cache
def _along_points(
    function: Callable[..., Any],
    carried: Layout,
    each: tuple[Layout, ...],
    shared: Layout,
    shown: Layout,
) -> Step:
    return named_step(function, function.__name__, carried, each, shared, shown)


_NOTHING = Layout()
_NONE = np.empty((0, 0))


@dataclass(frozen=True)
class Cubature(SigmaPoints):
    """The spherical-radial rule of third degree, 2 n points (Arasaratnam and Haykin, IEEE TAC 54,
    2009).

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> table = ib.run(model, {"ckf": ib.states.Filter(rule=ib.states.Cubature())}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    def points(self, n: int) -> tuple[Array, Array]:
        directions = np.concatenate([np.eye(n), -np.eye(n)])
        return np.sqrt(n) * directions, np.full(2 * n, 0.5 / n)


@dataclass(frozen=True)
class Unscented(SigmaPoints):
    """The 2 n + 1 points of Julier and Uhlmann (1997), scaled as by van der Merwe (dissertation,
    2004).

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> trackers = {"ukf": ib.states.Filter(rule=ib.states.Unscented(alpha=0.3))}
    >>> table = ib.run(model, trackers, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    kappa: Finite | None = None
    """Weight of the central point, in units of the others' doubled; None: 3 - n, and 0 where that
    is negative, since a negative weight costs the covariance its definiteness."""
    alpha: Positive = 1.0
    """Times the distance of the points."""
    beta: Finite = 0.0
    """Further weight of the central point in covariances: 2 is best for a square of normal
    numbers."""

    def kappa_of(self, n: int) -> float:
        return max(3.0 - n, 0.0) if self.kappa is None else self.kappa

    def points(self, n: int) -> tuple[Array, Array]:
        kappa = self.kappa_of(n)
        if n + kappa <= 0:
            raise UserError(
                f"kappa={kappa:g}: the points of {n} states need a kappa above {-n}; leave it out, "
                "or give a larger one"
            )
        # c = n + lambda with lambda = alpha^2 (n + kappa) - n
        c = self.alpha**2 * (n + kappa)
        directions = np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
        weights = np.concatenate([[1 - n / c], np.full(2 * n, 0.5 / c)])
        return np.sqrt(c) * directions, weights

    def covariance_weights(self, w: Array) -> Array:
        central = w[0] + 1 - self.alpha**2 + self.beta
        return np.concatenate([[central], w[1:]])


@dataclass(frozen=True)
class GaussHermite(SigmaPoints):
    """The product of Gauss-Hermite rules: order^n points (Ito and Xiong, IEEE TAC 45, 2000).

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> trackers = {"ghkf": ib.states.Filter(rule=ib.states.GaussHermite(order=3))}
    >>> table = ib.run(model, trackers, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    order: Count = 3

    def points(self, n: int) -> tuple[Array, Array]:
        s, w = self._line
        if self.order**n > _MOST_POINTS:
            raise UserError(
                f"order={self.order}: {self.order}^{n} points for {n} states; "
                "choose the rule Cubature"
            )
        # A point for each choice of n points of the line; its weight is the product of theirs.
        points = np.array(list(product(s, repeat=n)))
        weights = np.array([np.prod(c) for c in product(w, repeat=n)])
        return points, weights

    @cached_property
    def _line(self) -> tuple[Array, Array]:
        s, w = np.polynomial.hermite_e.hermegauss(self.order)
        return s, w / w.sum()


def slope(function: Callable[[Array], Array], x: Array) -> tuple[Array, Array]:
    """Computes the value (trials, m) and the Jacobian (trials, m, n) of a function at x (trials,
    n), by its own `slope` if it has one, else by complex steps."""
    own = getattr(function, "slope", None)
    if own is not None:
        return own(x)
    return function(x), by_complex_steps(function, x)
