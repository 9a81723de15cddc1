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
from typing import NamedTuple

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, multiply, own
from ipe_bench.basics.options import Component, Count, Finite, Positive
from ipe_bench.engine.points import regress, spread_points
from ipe_bench.functions.judged import by_complex_steps
from ipe_bench.states.algebra import Half, half, symmetric, transposed, triangular

_MOST_POINTS = 100_000
"""Points of a product rule at most."""
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


class Rule(Component, ABC):
    """A way to linearise a function about a normal distribution."""

    @abstractmethod
    def linearise(self, g: Function, m: Array, P: Array, nearest: Nearest | None = None) -> Affine:
        """Computes the affine law of g about N(m, P), for m (trials, n) and P (trials, n, n).
        `nearest` shifts values of g that are periodic next to others: the mean of points on both
        sides of a bearing's jump would lie opposite."""

    def linearise_by_root(
        self, g: Function, m: Array, F: Array, nearest: Nearest | None = None
    ) -> Affine:
        """Computes the affine law of g about N(m, F F'), for a triangular F (trials, n, n) with
        digits that F F' does not have."""
        return self.linearise(g, m, np.matmul(F, transposed(F)), nearest)

    def mean(self, g: Function, m: Array, P: Array) -> Array:
        """Computes the mean (trials, ...) of g over N(m, P), g (trials, p, ...) at points (trials,
        p, n)."""
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

    def linearise(self, g: Function, m: Array, P: Array, nearest: Nearest | None = None) -> Affine:
        y, J = slope(g, m)
        return Affine(J, y - multiply(J, m), np.zeros((*y.shape, y.shape[-1])))

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

    def linearise(self, g: Function, m: Array, P: Array, nearest: Nearest | None = None) -> Affine:
        s, w, c = _weighted(self, m.shape[-1])
        G, x = _spread(m, P, s)
        y = g(x)
        if nearest is not None:
            y = nearest(y, g(m)[:, None])
        mean, A, W = _regressed(G, y, s, w, c)
        return Affine(A, mean - multiply(A, m), W)

    def linearise_by_root(
        self, g: Function, m: Array, F: Array, nearest: Nearest | None = None
    ) -> Affine:
        s, w = self.points(m.shape[-1])
        G = triangular(F)
        y = g(m[..., None, :] + np.matmul(s, transposed(F)))
        if nearest is not None:
            y = nearest(y, g(m)[..., None, :])
        mean = np.sum(w[:, None] * y, axis=-2)
        d = y - mean[..., None, :]
        c = self.covariance_weights(w)[:, None]
        M = np.matmul(s.T, c * d)
        A = G.over(transposed(M))
        # What the law leaves of the points, which is no difference of large covariances.
        left = d - np.matmul(s, M)
        W = np.matmul(transposed(c * left), left)
        return Affine(A, mean - multiply(A, m), symmetric(W))

    def mean(self, g: Function, m: Array, P: Array) -> Array:
        s, w, _ = _weighted(self, m.shape[-1])
        _, points = _spread(m, P, s)
        values = g(points)
        return np.sum(w[:, None, None] * values, axis=-3)

    def calls(self, n: int, periodic: bool = False) -> int:
        return len(self.points(n)[1]) + periodic


@functools.lru_cache(maxsize=64)
def _weighted(rule: SigmaPoints, n: int) -> tuple[Array, Array, Array]:
    """Returns the points (p, n) of a rule with their weights (p,) in means and in covariances."""
    s, w = map(own, rule.points(n))
    return s, w, own(rule.covariance_weights(w))


def _spread(m: Array, P: Array, s: Array) -> tuple[Half, Array]:
    """Returns G with P = G G', and the points m + G s (trials, p, n)."""
    x, L = spread_points(m, P, s)
    G = half(P, L)
    rows = G.singular
    if rows.any():
        x[rows] = m[rows, None] + np.matmul(s, transposed(G.G[rows]))
    return G, x


def _regressed(G: Half, y: Array, s: Array, w: Array, c: Array) -> tuple[Array, Array, Array]:
    """Returns the mean, A and W of values y (trials, p, m) at such points: with d = y - mean,

    M = sum c d s',   A = M G^-1,   W = sum c d d' - M M'.
    """
    mean, M, A, W = regress(y, G.L, s, w, c)
    rows = G.singular
    if rows.any():
        A[rows] = np.matmul(M[rows], G.inverse[rows])
    return mean, A, W


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
