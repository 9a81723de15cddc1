"""Attempts fits that follow growing windows of data, for models with epochs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Covariance, finite_or, repeated
from ipe_bench.basics.streams import generator
from ipe_bench.estimators.driver import continued
from ipe_bench.estimators.ipe import starting_points
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Minima
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.solvers.attempts import Attempts, Rows
from ipe_bench.solvers.candidates import best_candidates

# Halved or doubled, each number here, those of `_CAREFUL_ITERATIONS`, `_THINNING` and `_GIVEN_UP`
# too, leaves 155 of 160 trials solved and the cost within 1 %: `python
# tests/benchmarks/constants.py windows`. Few of those trials need a further attempt. `_SLOW_GROWTH`
# and `_ONE` were not varied there.
_DAMPING = 1.0
"""lambda at the start of every window."""
_FIRST_ITERATIONS = 10
"""Steps in each window of the first attempt."""
_SLOW_GROWTH = 1.4
"""The most that the windows of a careful attempt grow."""
_CAREFUL_ITERATIONS = (60, 30)
"""Steps in the first window of a careful attempt, and in later ones."""
_FIRST_DRAWS = 16
_RANDOMISED = 2
"""Windows, those which leave much open, in which the prior of a candidate is centred at its own
start; one more with each attempt after the first from draws."""
_THINNING = (1, 1, 4, 8, 16, 32, 64)
"""One candidate in this many, the best ones, is kept by each window; at least one."""
_GIVEN_UP = (np.inf, 1e6, 1e3)
"""The mean squared residual above which the fit of the first window, the second, and a later one is
a wrong one, unless the best fit of all data so far is as bad: then R may be wrong."""
_AS_BAD = 2.0
_ONE = (0.03, 0.003)
"""Candidates closer than this, in deviations of the prior, are one: in the first window, and
later."""


@dataclass(frozen=True)
class Windows(Attempts):
    """Attempts fits that follow growing windows of data, for models with epochs.

    | attempt without, with a prior | begins from |
    |---|---|
    | 0; 0 | the start |
    | 1; 1 | the start, carefully: by more windows and more steps |
    | 2, 3; 3, 4 | the start, on all data, as attempts 0 and 1 of `Starts` |
    | 4 to 8; 2, 5 to 8 | 16, 32, ... 256 draws of the prior, or as far as the best fit lies |

    In the first two windows, whose fits have several minima of one depth, each candidate's prior is
    centred at its own draw: the randomised maximum likelihood of Oliver, He and Reynolds (5th
    European Conference on the Mathematics of Oil Recovery, 1996). Each later attempt from draws
    keeps the candidates apart for one window more.
    """

    planned = 9

    def _place(self, k: int) -> tuple[int | None, int]:
        """Tells which of the two attempts on all data the k-th one is, if any, and its place among
        those by windows: 0 and 1 are from the start, later ones from draws."""
        first = 2 if self.prior is None else 3
        by_windows = k if k < first else k - 2
        if first <= k < first + 2:
            return k - first, by_windows
        return None, by_windows

    def draws(self, k: int) -> int:
        plain, k = self._place(k)
        return 0 if plain is not None or k < 2 else _draws(k)

    def attempt(self, k: int, rows: Rows, before: Minima | None) -> Minima:
        """Attempts a fit; a careful attempt without a prior takes one in its windows that reaches
        as far as the linear estimate says."""
        last = k == self.last
        plain, k = self._place(k)
        if plain is not None:
            return self.plain(plain, rows)
        if before is None or self.prior is not None or self.problem.rankless:
            return self._grown(k, rows, before, last)
        result = before
        reach = self._reach(rows)
        for size in np.unique(reach):
            there = reach == size
            search = replace(self, prior=np.full(self.problem.measurement.n, size))
            found = search._grown(k, rows[there], take(before, there), last)
            result = put(result, there, found)
        return result

    def _reach(self, rows: Rows) -> Array:
        """Returns how far the parameters of the trials `rows` may lie if no prior says so: the
        median distance in the linear estimate, rounded up to a power of ten, since a prior ten
        times too wide does no harm."""
        tally = EvaluationCount.zeros(len(rows))
        x = starting_points(self.problem, self.z[rows], "linear_lse", tally)
        self.tally.simulations[rows] += tally.simulations
        distance = np.median(np.abs(x - self.problem.x0), axis=1)
        distance = finite_or(1.0, distance)
        return 10.0 ** np.ceil(np.log10(np.clip(distance, 1.0, 1e9)))

    def _grown(self, k: int, rows: Rows, before: Minima | None, last: bool) -> Minima:
        """Fits window after window, then all data without a prior. If none is known, draws reach as
        far as `before`."""
        epochs = self.problem.measurement.epochs
        assert epochs is not None
        start = self._starts(k, rows, before)
        owner = np.repeat(rows, _draws(k))
        found = Minima.nowhere(start, self.limits.history)
        metric = np.ones(start.shape[1]) if self.prior is None else self.prior
        careful = k > 0
        method = LevenbergMarquardtMethod(_DAMPING, metric, by_residual=careful, geodesic=careful)
        as_bad = self._as_bad(rows, before)
        growth = min(self.growth, _SLOW_GROWTH) if careful else self.growth
        # Windows whose fits have several minima of one depth: each candidate stays near its draw.
        apart = _RANDOMISED + max(0, k - 2)
        for number, stop in enumerate(window_stops(len(epochs), growth)):
            centre = start if number < apart else self.problem.x0
            objective = self._window(owner, stop, centre)
            steps = _of_window(_CAREFUL_ITERATIONS, number) if careful else _FIRST_ITERATIONS
            minima = self.minimize(owner, method, found.x, steps, objective, self.window_tolerance)
            fit = finite_or(np.inf, self._fit(minima, centre)) / objective.readings
            going_on = best_candidates(
                owner,
                minima.x / metric,
                fit,
                useless=np.maximum(as_bad[owner], _of_window(_GIVEN_UP, number)),
                most=max(1, _draws(k) // _of_window(_THINNING, number)),
                alike=_of_window(_ONE, number),
                last=last,
            )
            found = take(continued(found, minima), going_on)
            start = start[going_on]
            owner = owner[going_on]
        method = LevenbergMarquardtMethod(_DAMPING, metric)
        found = continued(found, self.minimize(owner, method, found.x, self.limits.max_iterations))
        return self._best(rows, owner, found)

    def _as_bad(self, rows: Rows, before: Minima | None) -> Array:
        """Computes the mean squared residual of each trial up to which a window's fit is no worse
        than the best so far."""
        limit = np.zeros(len(self.z))
        if before is not None:
            mean = _AS_BAD * before.chi_square / self.z.shape[1]
            limit[rows] = np.where(before.converged, mean, 0.0)
        return limit

    def _fit(self, minima: Minima, centre: Array) -> Array:
        """Computes the objective at minima, the prior included."""
        if self.prior is None:
            return minima.chi_square
        return minima.chi_square + np.sum(((minima.x - centre) / self.prior) ** 2, axis=1)

    def _starts(self, k: int, rows: Rows, before: Minima | None) -> Array:
        """Chooses the starts (candidates, n): the start in the first two attempts, then
        draws about it, trial by trial."""
        x0 = self.problem.x0
        n = len(x0)
        spread = np.ones(n) if self.prior is None else self.prior
        if self.prior is None and before is not None:
            distance = np.abs(before.x - x0)
            spread = np.maximum(1.0, finite_or(1.0, distance))
        draws = np.zeros((1, n))
        if k > 1:
            draws = generator(k).standard_normal((_draws(k), n))
        of_each = np.broadcast_to(spread, (len(rows), n))[:, None]
        return (x0 + of_each * draws).reshape(-1, n)

    def _best(self, rows: Rows, owner: Rows, found: Minima) -> Minima:
        """Returns each trial's best candidate; a trial that has none left has not arrived."""
        x0 = repeated(self.problem.x0, len(rows))
        result = Minima.nowhere(x0, self.limits.history)
        # By trial; those that converged first, and the lowest first among these.
        order = np.lexsort((finite_or(np.inf, found.chi_square), ~found.converged, owner))
        owners, first = np.unique(owner[order], return_index=True)
        return put(result, np.searchsorted(rows, owners), take(found, order[first]))

    def _window(self, owner: Rows, stop: int, centre: Array) -> Objective:
        """Makes the objective of each candidate on the first epochs, with the prior about
        `centre`."""
        model = self.problem.measurement
        assert model.epochs is not None
        arrived = model.rows(stop)
        share = stop / len(model.epochs)
        window = self.counted(SubsetModel.until(model, stop, coarse=True), owner, share)
        R = self.problem.R.restricted(arrived)
        z = self.z[np.ix_(owner, arrived)]
        prior = None if self.prior is None else Covariance(self.prior)
        return Objective(window, R, z, np.arange(len(owner)), centre, prior).coarsened(0.0)


def _of_window(values: Sequence[Any], number: int) -> Any:
    """Returns the value for a window; the last one is for all windows from there on."""
    return values[min(number, len(values) - 1)]


def _draws(k: int) -> int:
    """Returns the number of candidates that the k-th attempt by windows begins with."""
    return _FIRST_DRAWS * 2 ** (k - 2) if k > 1 else 1


def window_stops(epochs: int, growth: float) -> list[int]:
    """Computes the number of epochs of each window, the last one short of all: 1, 2, 4, 8, 16 of 30
    for growth 2."""
    growing = (growth**i for i in itertools.count())
    lengths = itertools.takewhile(lambda length: length < epochs, growing)
    return sorted({round(length) for length in lengths} - {epochs})
