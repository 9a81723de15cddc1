"""Attempts at least squares by growing windows of data: several candidates per trial, the best of which go on."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import starting_points
from ipe_bench.estimators.least_squares import Minima, Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.base import Restricted
from ipe_bench.measurements.counted import Counted, Tally
from ipe_bench.solvers.search import Search

_SLOW_GROWTH = 1.4
_CAREFUL_ITERATIONS = (60, 30)
"""In the first window of a careful attempt, and in later ones."""
_FIRST_DRAWS = 16
_RANDOMISED = 2
"""In so many windows, which leave much open, the prior of a candidate is centred at its own start; in one more with
each attempt after the first from draws."""
_THINNING = (1, 1, 4, 8, 16, 32, 64)
"""Of the candidates that there were at the start, each window keeps the best one in so many; one at least."""
GIVEN_UP = 1e3
"""The mean squared residual above which a fit is a wrong one,"""
_GIVEN_UP = (np.inf, 1e6, GIVEN_UP)
"""and above which a window's fit is: in the first window, the second, and later."""
_ONE = (0.03, 0.003)
"""Candidates closer than this, in deviations of the prior, are one: in the first window, and later."""


@dataclass(frozen=True)
class Candidates:
    """Where the candidates of some trials have come; every field has the candidates in front."""

    x: Array
    start: Array
    """Where they began."""
    owner: NDArray[np.intp]
    """The trial (candidates,) that each belongs to."""
    iterations: NDArray[np.int64]
    path: list[Array] | None
    """The iterates so far, where a history was asked for."""

    @classmethod
    def at(cls, x: Array, owner: NDArray[np.intp], history: bool) -> Candidates:
        return cls(x, x, owner, np.zeros(len(x), np.int64), [row[None] for row in x] if history else None)

    def moved(self, minima: Minima) -> Candidates:
        """The same candidates where a minimisation has led them."""
        path = self.path
        if path is not None and minima.history is not None:
            path = [np.concatenate([old, new[1:]]) for old, new in zip(path, minima.history, strict=True)]
        return replace(self, x=minima.x, iterations=self.iterations + minima.iterations, path=path)


@dataclass(frozen=True)
class Windows(Search):
    """From the nominal point, then carefully from there, then from 16, 32, ... 256 draws of the prior.

    The first two windows have about as many readings as there are parameters, so their fits have several minima of
    one depth, and a common prior would draw all candidates to one of them. Until then each candidate's prior is
    centred at its own draw, which makes the candidates about a sample of what the readings so far leave possible: the
    randomised maximum likelihood of Oliver, He and Reynolds (5th European Conference on the Mathematics of Oil
    Recovery, 1996). Where that fails, a minimum of the next window has drawn them all: so each later attempt keeps them
    apart for one window more.
    """

    attempts = 7
    enough = 1

    def attempt(self, k: int, rows: NDArray[np.intp], before: Minima | None) -> Minima:
        """The k-th attempt for the trials `rows`, of which `before` is the best so far.

        A careful attempt without a prior takes one in its windows that reaches as far as the linear estimate says.
        """
        if before is None or self.prior is not None or not self.options.use_prior or self.problem.rankless:
            return self._attempt(k, rows, before)
        result, reach = before, self._reach(rows)
        for size in np.unique(reach):
            there = reach == size
            prior = np.full(self.problem.measurement.n, size)
            search = replace(self, problem=replace(self.problem, prior_deviation=prior, prior_correlation=None))
            result = put(result, there, search._attempt(k, rows[there], take(before, there)))
        return result

    def _reach(self, rows: NDArray[np.intp]) -> Array:
        """How far the parameters of the trials `rows` may lie, where no prior says so: the median of the distances in
        the linear estimate, rounded up to a power of ten. On GINS that median is mostly right within a factor of three
        at any scale, and a prior ten times too wide does no harm."""
        tally = Tally.zeros(len(rows))
        x = starting_points(self.problem, self.z[rows], "linear_lse", tally)
        self.tally.simulations[rows] += tally.simulations
        distance = np.median(np.abs(x - self.problem.x0), axis=1)
        return 10.0 ** np.ceil(np.log10(np.clip(np.where(np.isfinite(distance), distance, 1.0), 1.0, 1e9)))

    def _attempt(self, k: int, rows: NDArray[np.intp], before: Minima | None) -> Minima:
        """Window after window, then all data without the prior. Where none is known, draws reach as far as `before`."""
        prior = self.prior
        metric = np.ones(self.problem.measurement.n) if prior is None else prior
        there = self._begin(k, rows, metric if prior is not None or before is None else _reach(before, self.problem.x0))
        method = LevenbergMarquardtMethod(self.options.damping, metric, by_residual=k > 0, geodesic=k > 0)
        for number, (epochs, arrived) in enumerate(self._windows(k)):
            centre = there.start if number < self._randomised(k) else self.problem.x0
            objective = self._window(there.owner, epochs, arrived, centre)
            limit = _CAREFUL_ITERATIONS[min(number, 1)] if k else self.options.window_iterations
            minima = self.minimize(
                objective, there.owner, method, there.x, tolerance=self.options.window_tolerance, limit=limit
            )
            fit = minima.chi_square if prior is None else minima.chi_square + _far(minima.x, centre, prior)
            per_reading = np.where(np.isfinite(fit), fit, np.inf) / objective.readings
            there = take(there.moved(minima), self._kept(k, number, there.owner, minima.x / metric, per_reading))
        last = LevenbergMarquardtMethod(self.options.damping, metric)
        tolerance, limit = self.options.tolerance, self.options.max_iterations
        minima = self.minimize(self.whole(there.owner), there.owner, last, there.x, tolerance=tolerance, limit=limit)
        there = there.moved(minima)
        return self._best(rows, there, replace(minima, iterations=there.iterations, history=there.path))

    def _randomised(self, k: int) -> int:
        """In how many windows of the k-th attempt each candidate has its own prior."""
        return _RANDOMISED + max(0, k - 2)

    def _begin(self, k: int, rows: NDArray[np.intp], spread: Array) -> Candidates:
        """The nominal point twice, then draws about it."""
        x0, n = self.problem.x0, self.problem.measurement.n
        draws = np.zeros((1, n))
        if k > 1:
            draws = np.random.Generator(np.random.Philox(k)).standard_normal((_draws(k), n))
        spread = np.broadcast_to(spread, (len(rows), n))
        x = (x0 + spread[:, None] * draws).reshape(-1, n)
        return Candidates.at(x, np.repeat(rows, len(draws)), self.history)

    def _windows(self, k: int) -> Iterator[tuple[int, NDArray[np.intp]]]:
        """Each window's number of epochs and its readings; all data are left to the last pass."""
        model = self.problem.measurement
        assert model.epochs is not None
        growth = min(self.options.growth, _SLOW_GROWTH) if k else self.options.growth
        for stop in window_stops(len(model.epochs), growth):
            yield stop, model.rows(stop)

    def _window(self, owner: NDArray[np.intp], epochs: int, arrived: NDArray[np.intp], centre: Array) -> Objective:
        """The objective of each candidate in a window, with the prior about `centre`."""
        problem, model = self.problem, self.problem.measurement
        assert model.epochs is not None
        window = Counted(Restricted.until(model, epochs, coarse=True), self.spent(owner), epochs / len(model.epochs))
        R, z = problem.R.restricted(arrived), self.z[np.ix_(owner, arrived)]
        prior = None if self.prior is None else Covariance(self.prior)
        return Objective(window, R, z, np.arange(len(owner)), centre, prior).coarsened(0.0)

    def _kept(self, k: int, number: int, owner: NDArray[np.intp], x: Array, per_reading: Array) -> NDArray[np.intp]:
        """The candidates that go on: of each trial the best few that differ and are not given up; one in any case in
        the last attempt, and where there is no fit at all: that ends with its own status."""
        most = max(1, _draws(k) // _THINNING[min(number, len(_THINNING) - 1)])
        limit = _GIVEN_UP[min(number, len(_GIVEN_UP) - 1)]
        if len(np.unique(owner)) == len(owner):  # nothing to choose among
            return np.flatnonzero((per_reading <= limit) | (k == self.last) | np.isinf(per_reading))
        order = np.lexsort((per_reading, owner))
        kept: list[int] = []
        for _, group in itertools.groupby(order.tolist(), key=lambda i: owner[i]):
            chosen: list[int] = []
            for i in group:
                alike = any(np.abs(x[i] - x[j]).max() <= _ONE[min(number, 1)] for j in chosen)
                good = per_reading[i] <= limit or (not chosen and (k == self.last or np.isinf(per_reading[i])))
                if len(chosen) < most and good and not alike:
                    chosen.append(i)
            kept += chosen
        return np.array(sorted(kept), dtype=np.intp)

    def _best(self, rows: NDArray[np.intp], there: Candidates, minima: Minima) -> Minima:
        """Of each trial's candidates the best; a trial that has none left has not arrived."""
        n = self.problem.measurement.n
        trials = len(rows)
        result = Minima(
            np.repeat(self.problem.x0[None], trials, axis=0),
            np.full(trials, Status.MAX_ITERATIONS, np.int8),
            np.zeros(trials, np.int64),
            [self.problem.x0[None]] * trials if self.history else None,
            np.full((trials, n, n), np.nan),
            np.full(trials, np.inf),
            np.full(trials, np.inf),
        )
        fit = np.where(np.isfinite(minima.chi_square), minima.chi_square, np.inf)
        order = np.lexsort((fit, ~minima.converged, there.owner))
        owner, first = np.unique(there.owner[order], return_index=True)
        return put(result, np.searchsorted(rows, owner), take(minima, order[first]))


def _draws(k: int) -> int:
    """How many candidates the k-th attempt begins with."""
    return _FIRST_DRAWS * 2 ** (k - 2) if k > 1 else 1


def window_stops(epochs: int, growth: float) -> list[int]:
    """How many epochs each window has, the last one short of all: 1, 2, 4, 8, 16 of 30 for growth 2."""
    lengths = itertools.takewhile(lambda length: length < epochs, (growth**i for i in itertools.count()))
    return sorted({round(length) for length in lengths} - {epochs})


def _far(x: Array, x0: Array, prior: Array) -> Array:
    """The prior's part of the objective."""
    return np.sum(((x - x0) / prior) ** 2, axis=1)


def _reach(before: Minima, x0: Array) -> Array:
    """How far draws reach without a prior (trials, n): as far as the attempts before have led."""
    distance = np.abs(before.x - x0)
    return np.maximum(1.0, np.where(np.isfinite(distance), distance, 1.0))
