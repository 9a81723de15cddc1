"""Attempts at least squares where the order of the readings says nothing: other metrics first, then other starts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array
from ipe_bench.estimators.least_squares import Minima, squared
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.solvers.search import Search

_LONG = 600
"""Iterations of an attempt from the nominal point, and of one from elsewhere that promises something."""
_SHORT = 60
_RAYS = tuple(sign * 10.0**exponent for exponent in np.arange(-3, 1.01, 0.25) for sign in (1, -1))
"""Multiples of the nominal point that are looked at as starts."""
_APART = 0.6
"""Two starts on one ray are different where their sizes are, by this power of ten."""
_DRAWN = 20
"""Random points of which the best is a start."""
_PROMISING = 1e-3


@dataclass(frozen=True)
class Stages(Search):
    """From the nominal point with damping in the parameters' sizes, then in Marquardt's metric; from the two best
    points on the ray through the nominal point; then from the best of 20 random points, again and again.
    """

    attempts = 12
    enough = 4  # they all begin near each other

    def attempt(self, k: int, rows: NDArray[np.intp], before: Minima | None) -> Minima:
        """The k-th attempt for the trials `rows`; `before` is the best of those so far."""
        if k < 2:
            method = LevenbergMarquardtMethod(1.0, sizes=1.0) if k == 0 else LevenbergMarquardtMethod(1e-3)
            return self._run(rows, method, self._nominal(rows), _LONG)
        assert before is not None
        method = LevenbergMarquardtMethod(1e-2, sizes=1e-3)
        start = self._on_a_ray(rows, k - 2) if k < 4 else self._at_random(rows, k)
        found = self._run(rows, method, start, _SHORT)
        promising = ~found.converged & (found.chi_square < before.chi_square * (1 - _PROMISING))
        if not promising.any():
            return found
        on = self._run(rows[promising], method, found.x[promising], _LONG)
        return put(found, promising, _after(take(found, promising), on))

    def _nominal(self, rows: NDArray[np.intp]) -> Array:
        return np.repeat(self.problem.x0[None], len(rows), axis=0)

    def _on_a_ray(self, rows: NDArray[np.intp], rank: int) -> Array:
        """Of the points on the ray the best, or the second best that is not about the same."""
        x0 = self.problem.x0
        base = x0 if x0.any() else np.ones(len(x0))
        points = np.multiply.outer(np.array(_RAYS), base)
        cost = self._look(rows, np.repeat(points[None], len(rows), axis=0))
        chosen = np.argmin(cost, axis=1)
        if rank:
            best = np.array(_RAYS)[chosen][:, None]
            alike = (np.sign(best) == np.sign(_RAYS)) & (np.abs(np.log10(np.abs(_RAYS / best))) < _APART)
            chosen = np.argmin(np.where(alike, np.inf, cost), axis=1)
        return points[chosen]

    def _at_random(self, rows: NDArray[np.intp], k: int) -> Array:
        """The best of 20 random points: of the prior where one is known, else of any size, or about the nominal."""
        x0, n = self.problem.x0, len(self.problem.x0)
        rng = np.random.Generator(np.random.Philox(k))
        prior = self.prior
        if prior is not None:
            points = x0 + prior * rng.standard_normal((_DRAWN, n))
        elif k % 2 == 0:
            points = 10 ** rng.uniform(-2, 0.5, (_DRAWN, n)) * rng.choice([-1.0, 1.0], (_DRAWN, n))
        else:
            points = 10 ** rng.uniform(-2.5, 0.5, (_DRAWN, 1)) * (x0 + 0.5 * rng.standard_normal((_DRAWN, n)))
        cost = self._look(rows, np.repeat(points[None], len(rows), axis=0))
        return points[np.argmin(cost, axis=1)]

    def _look(self, rows: NDArray[np.intp], points: Array) -> Array:
        """The objective (trials, points) at points (trials, points, n), counted; infinite where there is none."""
        cost = np.full(points.shape[:2], np.inf)
        objective = self.whole(rows)
        for i in range(points.shape[1]):
            cost[:, i] = squared(objective.residual(points[:, i]))
        self.charge(rows, objective.model.tally)
        return np.where(np.isfinite(cost), cost, np.inf)

    def _run(self, rows: NDArray[np.intp], method: LevenbergMarquardtMethod, x: Array, limit: int) -> Minima:
        limit = max(limit, self.options.max_iterations)
        return self.minimize(self.whole(rows), rows, method, x, tolerance=self.options.tolerance, limit=limit)


def _after(first: Minima, second: Minima) -> Minima:
    """The second of two minimisations, with the iterations and iterates of both."""
    history = second.history
    if first.history is not None and history is not None:
        history = [np.concatenate([a, b[1:]]) for a, b in zip(first.history, history, strict=True)]
    return replace(second, iterations=first.iterations + second.iterations, history=history)
