"""Attempts fits on all data from other starts, for models without epochs: multistart, which first
looks where a start promises most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, finite_or, repeated, squared
from ipe_bench.basics.streams import generator
from ipe_bench.estimators.driver import continued
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Minima
from ipe_bench.solvers.attempts import LONG, Attempts, Rows
from ipe_bench.solvers.candidates import best_candidates

# Halved or doubled, each plain number here leaves 155 of 160 trials solved, but for one fewer with
# half of `_LOOKS`, and the cost within 1 %: `python tests/benchmarks/constants.py starts`. Few of
# those trials need a further attempt. Tuples were not varied.
_PROMISING = 1e-3
"""The share by which a fit that has not converged must be better than the best one so far to
promise something."""
_FROM_AFAR = LevenbergMarquardtMethod(1e-2, sizes=1e-3)
_SHORT = 60
"""Iterations of an attempt from elsewhere that does not promise anything yet."""
_RAYS = np.array(
    [sign * 10.0**exponent for exponent in np.arange(-3, 1.01, 0.25) for sign in (1, -1)]
)
"""Multiples of the start that are looked at as points to begin from."""
_APART = 0.6
"""Two starts on one ray are different where their sizes are, by this power of ten."""
_LOOKS = 20
"""Random points of which the best is a start."""
_RANDOM = 4
"""The first attempt from a random start."""
_HALVING = (6, 13, 14, 15)
"""The attempts that begin from several random starts."""
_LOOKED_AT = (4, 5, 7, 8, 9, 10, 11, 12)
"""The attempts that begin from the best of several random points."""
_HALVINGS = ((5, 5), (15, 2), (_SHORT, 1))
"""Steps from each of these starts, and how many of them are kept."""


@dataclass(frozen=True)
class Starts(Attempts):
    """Attempts fits on all data from other starts.

    | attempt | begins from |
    |---|---|
    | 0, 1 | the start, in the metric of the sizes, then in Marquardt's |
    | 2, 3 | the best point on the ray through the start, and the best unlike it |
    | 4, 5, 7 to 12 | the best of 20 random points |
    | 6, 13 to 15 | 20 random points of any size, of which a few steps choose |
    """

    planned = 16
    repeats = 3
    most = 1500.0

    def draws(self, k: int) -> int:
        return _LOOKS if k >= _RANDOM else 0

    def attempt(self, k: int, rows: Rows, before: Minima | None) -> Minima:
        if k < 2:
            return self.plain(k, rows)
        assert before is not None
        if k in _HALVING:
            return self._carried_on(rows, self._halved(k, rows), before)
        points = self._looked_at(k)
        cost = self._look(rows, points)
        chosen = _best_unlike_the_best(cost) if k == 3 else np.argmin(cost, axis=1)
        steps = max(_SHORT, self.limits.max_iterations)
        found = self.minimize(rows, _FROM_AFAR, points[chosen], steps)
        return self._carried_on(rows, found, before)

    def _carried_on(self, rows: Rows, found: Minima, before: Minima) -> Minima:
        """Goes on with the fits that have not converged, and are better than those `before`."""
        better = found.chi_square < before.chi_square * (1 - _PROMISING)
        promising = ~found.converged & better
        if not promising.any():
            return found
        first = take(found, promising)
        steps = max(LONG, self.limits.max_iterations)
        on = self.minimize(rows[promising], _FROM_AFAR, first.x, steps)
        return put(found, promising, continued(first, on))

    def _looked_at(self, k: int) -> Array:
        """Returns the points (points, n) of which the k-th attempt begins from one."""
        x0 = self.problem.x0
        if k < _RANDOM:
            direction = x0 if x0.any() else np.ones(len(x0))
            return np.multiply.outer(_RAYS, direction)
        stream = _stream(k)
        if self.prior is not None:
            return self._of_prior(self.prior, stream)
        return self._of_any_size(stream) if stream % 2 == 0 else self._about_start(stream)

    def _of_prior(self, prior: Array, stream: int) -> Array:
        x0 = self.problem.x0
        return x0 + prior * generator(stream).standard_normal((_LOOKS, len(x0)))

    def _of_any_size(self, stream: int) -> Array:
        """Draws points of any sign, from a hundredth to 3."""
        shape = (_LOOKS, len(self.problem.x0))
        rng = generator(stream)
        return 10 ** rng.uniform(-2, 0.5, shape) * rng.choice([-1.0, 1.0], shape)

    def _about_start(self, stream: int) -> Array:
        """Draws points about multiples of the start."""
        x0 = self.problem.x0
        rng = generator(stream)
        factor = 10 ** rng.uniform(-2.5, 0.5, (_LOOKS, 1))
        return factor * (x0 + 0.5 * rng.standard_normal((_LOOKS, len(x0))))

    def _wide(self, stream: int) -> Array:
        """Draws points about 1 in magnitude, in the quadrant of the start or one nearby, which a
        prior that is too narrow does not hinder."""
        x0 = self.problem.x0
        shape = (_LOOKS, len(x0))
        rng = generator(stream)
        turned = np.where(rng.uniform(size=shape) < 0.8, 1.0, -1.0)
        sign = turned * np.where(x0 < 0, -1.0, 1.0)
        return sign * 10 ** rng.normal(0.0, 1.0, shape)

    def _halved(self, k: int, rows: Rows) -> Minima:
        """Starts from 20 wide draws and drops the worst after few steps (successive halving): how
        well a start fits says little."""
        owner = np.repeat(rows, _LOOKS)
        x = np.tile(self._wide(_stream(k)), (len(rows), 1))
        found = Minima.nowhere(x, self.limits.history)
        for steps, most in _HALVINGS:
            found = continued(found, self.minimize(owner, _FROM_AFAR, found.x, steps))
            # Even the worst fit may go on.
            useless = np.full(len(owner), np.inf)
            fit = finite_or(np.inf, found.chi_square)
            chosen = best_candidates(owner, found.x, fit, useless, most=most)
            found = take(found, chosen)
            owner = owner[chosen]
        return found

    def _look(self, rows: Rows, points: Array) -> Array:
        """Computes the objective (trials, points) at points (points, n), counted; infinite where
        there is none."""
        objective = self.whole(rows)
        cost = []
        for point in points:
            x = repeated(point, len(rows))
            cost.append(squared(objective.residual(x)))
        self.charge(rows, objective.model.tally)
        return finite_or(np.inf, np.stack(cost, axis=1))


def _stream(k: int) -> int:
    """Returns the number of the random stream of the k-th attempt, which is its own: draws of two
    attempts are independent."""
    return _RANDOM + (*_LOOKED_AT, *_HALVING).index(k)


def _best_unlike_the_best(cost: Array) -> Rows:
    """Chooses the point on the ray of least cost (trials, points) among those that have another
    sign or size than the best one."""
    best = _RAYS[np.argmin(cost, axis=1)][:, None]
    same_side = np.sign(best) == np.sign(_RAYS)
    decades = np.abs(np.log10(np.abs(_RAYS / best)))
    alike = same_side & (decades < _APART)
    return np.argmin(np.where(alike, np.inf, cost), axis=1)
