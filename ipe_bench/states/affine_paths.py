"""Solves affine models about paths: their states of least cost, and covariances.

Such a model has states x of epochs k = 0 ... K, with x[-1] = 0, unit noise w and readings v:

    x[k] = A[k] x[k-1] + a[k] + G[k] w[k],   |w|^2 + |v - B x|^2 + x' D x  least

with a diagonal D that damps. It is solved by two passes of the steps of `information`: back from
the last epoch, which leaves how states *follow* from those before if all readings are known, and
ahead from the first. A trial has the same bits in any batch.

Arrays of states hold 1 + K epochs, and those of what leads to a state or is read of it the K from
the second on: `A[:, k - 1]` leads to `x[:, k]`. `Step.run` lets the shorter ones lack their first
epoch, so that one number k counts in all of them.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, own
from ipe_bench.states.information import Steps, steps_of
from ipe_bench.states.layouts import Shape, packed

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
        # An undamped trial has the same bits beside damped ones.
        damped = np.asarray(damping.any(axis=(1, 2)))
        plain = ~damped
        x = np.empty(a.shape)
        x[damped] = self._states(of, *_rows(damped, *given, np.sqrt(damping)))
        if plain.any():
            x[plain] = self._states(of, *_rows(plain, *given))
        return x

    def _states(self, of: Tangents, *given: Array) -> Array:
        """Computes the states for A, B, a, v and, if they are damped, roots of D."""
        steps = self._steps_of(of, damped=len(given) > 4)
        given = tuple(map(own, given))
        later = len(self.gains)
        x = np.empty(given[2].shape)
        for rows, follows in self._pieces(steps, len(x)):
            first = self._pass_back(steps, _rows(rows, *given), follows)
            states = x[rows]
            states[:, 0] = steps.first.part(first, "x")
            carry = states[:, 0].copy()
            steps.ahead.run(carry, [follows], _NONE, states, first=1, by=1, count=later)
        return x

    def spread(self, of: Tangents) -> Given:
        """Computes what all readings say of the states."""
        trials, K, n, _ = of.A.shape
        steps = self._steps_of(of, damped=False)
        # Covariances do not depend on what is read.
        a = np.zeros((trials, 1 + K, n))
        v = np.zeros(of.B.shape[:3])
        given = own(of.A), own(of.B), a, v
        P = np.empty((trials, 1 + K, n * n))
        with_last = np.empty(P.shape)
        log_pivots = np.empty(trials)
        for rows, follows in self._pieces(steps, trials):
            first = self._pass_back(steps, _rows(rows, *given), follows)
            P[rows, 0] = steps.first.part(first, "covariance")
            F = steps.first.part(first, "F").copy()
            steps.covariances.run(F, [follows], _NONE, P[rows], first=1, by=1, count=K)
            # The last states with themselves, and from there back.
            last = np.tile(np.eye(n).ravel(), (len(follows), 1))
            crossed = with_last[rows]
            each = [P[rows], follows]
            steps.crossed.run(last, each, _NONE, crossed, first=K, by=-1, count=1 + K)
            # det R'R is that of the Hessian.
            of_first = steps.first.part(first, "pivots")
            of_later = steps.follows.part(follows[:, 1:], "pivots")
            log_pivots[rows] = np.log(of_first).sum(axis=1)
            log_pivots[rows] += np.log(of_later).sum(axis=(1, 2))
        shape = trials, 1 + K, n, n
        return Given(P.reshape(shape), with_last.reshape(shape), 2 * log_pivots)

    def _pass_back(self, steps: Steps, given: Sequence[Array], follows: Array) -> Array:
        """Fills how states follow from those before (trials, 1 + K, t), from the second on, and
        returns what is said of the first (trials, s)."""
        trials, epochs, _ = follows.shape
        start, gains = self._shared
        carry = np.zeros((trials, steps.said.size))
        steps.back.run(carry, given, gains, follows, first=epochs - 1, by=-1, count=epochs - 1)
        first = np.empty((trials, 1, steps.first.size))
        _, _, a, _, *D = given
        steps.begin.run(carry, [a, *D], start, first, first=0, by=1, count=1)
        return first[:, 0]

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
        filtered = self._steps_of(of, damped=False).filter
        filtered.run(carry, given, self._shared[1], variances, first=1, by=1, count=K)
        return variances, carry[:, -1]

    def _pieces(self, steps: Steps, trials: int) -> Iterator[tuple[slice, Array]]:
        """Yields trials that are held at once, with room for how their states follow (trials, 1 +
        K, t)."""
        size = steps.follows.size
        epochs = 1 + len(self.gains)
        at_once = max(_LANES, int(_NUMBERS / (epochs * size)) // _LANES * _LANES)
        follows = np.empty((min(trials, at_once), epochs, size))
        # Nothing leads to the first states, yet the pass of `crossed` reads a row there, too.
        follows[:, 0] = 0.0
        for i in range(0, trials, at_once):
            rows = slice(i, min(i + at_once, trials))
            yield rows, follows[: rows.stop - i]

    def _steps_of(self, of: Tangents, damped: bool) -> Steps:
        return steps_of(of.B.shape[2], *self._shapes, damped)

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


def _rows(rows: Mask | slice, *parts: Array) -> list[Array]:
    return [part[rows] for part in parts]


def _places(some: Array) -> Shape:
    return tuple(map(tuple, some.tolist()))
