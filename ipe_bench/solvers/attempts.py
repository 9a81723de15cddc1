"""Attempts at least squares from far away: by growing windows of data where readings arrive in epochs, and from other
starts and metrics. Which trials need another attempt is left to `progressive`.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import starting_points
from ipe_bench.estimators.least_squares import Minima, Objective, minimize, squared
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Limits:
    """What an attempt may do; see the options of `Progressive` of the same names."""

    tolerance: float
    max_iterations: int
    budget: float | None
    growth: float
    window_tolerance: float
    restarts: int | None


@dataclass(frozen=True)
class Attempts(ABC):
    """The attempts at one batch z (trials, m), which share its tally."""

    limits: Limits
    problem: Problem
    prior: Array | None
    """The deviations (n,) of the prior that counts; None where none does. Its correlations do not: a search ends in a
    fit without the prior."""
    z: Array
    tally: EvaluationCount
    history: bool

    planned: int = 0
    """How many attempts there are."""
    repeats: int = 1
    """How many attempts from independent draws must lead to a minimum again for it to be believed."""

    @property
    def last(self) -> int:
        """The number of the last attempt; the first is 0."""
        return self.planned - 1 if self.limits.restarts is None else min(self.limits.restarts, self.planned - 1)

    @abstractmethod
    def attempt(self, k: int, rows: Rows, before: Minima | None) -> Minima:
        """The k-th attempt for the trials `rows`; `before` is the best of those so far."""

    @abstractmethod
    def draws(self, k: int) -> int:
        """How many independent draws the k-th attempt begins from; 0 if it begins at the nominal point or where the
        readings point."""

    def plain(self, k: int, rows: Rows) -> Minima:
        """Levenberg-Marquardt on all data from the nominal point: in the metric of the parameters' sizes, and in
        Marquardt's."""
        method = (LevenbergMarquardtMethod(1.0, sizes=1.0), LevenbergMarquardtMethod(1e-3))[k]
        return self.run(rows, method, self.nominal(rows), _LONG)

    def nominal(self, rows: Rows) -> Array:
        return np.repeat(self.problem.x0[None], len(rows), axis=0)

    def run(self, rows: Rows, method: LevenbergMarquardtMethod, x: Array, limit: int) -> Minima:
        limit = max(limit, self.limits.max_iterations)
        return self.minimize(self.whole(rows), rows, method, x, tolerance=self.limits.tolerance, limit=limit)

    def whole(self, owner: Rows) -> Objective:
        """The objective on all data for candidates of the trials `owner`."""
        model = CountingModel(self.problem.measurement, self.spent(owner))
        return Objective(model, self.problem.R, self.z[owner], np.arange(len(owner)), self.problem.x0)

    def spent(self, owner: Rows) -> EvaluationCount:
        """A tally for candidates of the trials `owner`, which begins at what each trial has cost so far."""
        return EvaluationCount(
            self.tally.simulations[owner], self.tally.jacobians[owner], np.zeros(len(owner), dtype=bool)
        )

    def charge(self, owner: Rows, tally: EvaluationCount) -> None:
        """Adds to each trial what its candidates have cost since `spent`."""
        for total, now in ((self.tally.simulations, tally.simulations), (self.tally.jacobians, tally.jacobians)):
            np.add.at(total, owner, now - total[owner])
        for candidate, message in tally.messages.items():
            self.tally.messages.setdefault(int(owner[candidate]), message)

    def minimize(
        self,
        objective: Objective,
        owner: Rows,
        method: LevenbergMarquardtMethod,
        x: Array,
        *,
        tolerance: float,
        limit: int,
    ) -> Minima:
        """One minimisation from x (candidates, n), charged to the trials `owner`."""
        minima = minimize(
            objective,
            method,
            x,
            tolerance=tolerance,
            max_iterations=limit,
            budget=self.limits.budget,
            history=self.history,
        )
        self.charge(owner, objective.model.tally)
        return minima


_LONG = 600
"""Iterations of an attempt from the nominal point, and of one from elsewhere that promises something."""
_SHORT = 60
_RAYS = tuple(sign * 10.0**exponent for exponent in np.arange(-3, 1.01, 0.25) for sign in (1, -1))
"""Multiples of the nominal point that are looked at as starts."""
_APART = 0.6
"""Two starts on one ray are different where their sizes are, by this power of ten."""
_LOOKS = 20
"""Random points of which the best is a start."""
_PROMISING = 1e-3
_RANDOM = 4
_HALVING = (6, 13, 14, 15)
"""The attempts that begin from several random starts."""
_HALVINGS = ((5, 5), (15, 2), (_LONG, 1))
"""The first attempt from a random start."""


@dataclass(frozen=True)
class Stages(Attempts):
    """From the nominal point under two metrics; from the two best points on the ray through the nominal point; then
    from the best of 20 random points, again and again."""

    planned: int = 16
    repeats: int = 3

    def draws(self, k: int) -> int:
        return _LOOKS if k >= _RANDOM else 0

    def attempt(self, k: int, rows: Rows, before: Minima | None) -> Minima:
        if k < 2:
            return self.plain(k, rows)
        assert before is not None
        method = LevenbergMarquardtMethod(1e-2, sizes=1e-3)
        if k in _HALVING:
            return self._halved(rows, k)
        start = self._on_a_ray(rows, k - 2) if k < _RANDOM else self._at_random(rows, k if k < 6 else k - 1)
        found = self.run(rows, method, start, _SHORT)
        promising = ~found.converged & (found.chi_square < before.chi_square * (1 - _PROMISING))
        if not promising.any():
            return found
        on = self.run(rows[promising], method, found.x[promising], _LONG)
        return put(found, promising, _after(take(found, promising), on))

    def _on_a_ray(self, rows: Rows, rank: int) -> Array:
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

    def _at_random(self, rows: Rows, k: int) -> Array:
        """The best of 20 random points: of the prior where one is known, else of any size, or about the nominal."""
        x0, n = self.problem.x0, len(self.problem.x0)
        rng = np.random.Generator(np.random.Philox(k))
        if self.prior is not None:
            points = x0 + self.prior * rng.standard_normal((_LOOKS, n))
        elif k % 2 == 0:
            points = 10 ** rng.uniform(-2, 0.5, (_LOOKS, n)) * rng.choice([-1.0, 1.0], (_LOOKS, n))
        else:
            points = 10 ** rng.uniform(-2.5, 0.5, (_LOOKS, 1)) * (x0 + 0.5 * rng.standard_normal((_LOOKS, n)))
        cost = self._look(rows, np.repeat(points[None], len(rows), axis=0))
        return points[np.argmin(cost, axis=1)]

    def _halved(self, rows: Rows, k: int) -> Minima:
        """From 20 wide draws, of which few steps thin out those that fit worst: how well a start fits says little."""
        x0, n = self.problem.x0, len(self.problem.x0)
        rng = np.random.Generator(np.random.Philox(k))
        if self.prior is not None:
            points = x0 + self.prior * rng.standard_normal((_LOOKS, n))
        else:
            sign = np.where(rng.uniform(size=(_LOOKS, n)) < 0.8, 1.0, -1.0) * np.where(x0 < 0, -1.0, 1.0)
            points = sign * 10 ** rng.normal(0.0, 1.0, (_LOOKS, n))
        owner, x = np.repeat(rows, _LOOKS), np.tile(points, (len(rows), 1))
        found: Minima | None = None
        for steps, kept in _HALVINGS:
            method = LevenbergMarquardtMethod(1e-2, sizes=1e-3)
            found = self.minimize(self.whole(owner), owner, method, x, tolerance=self.limits.tolerance, limit=steps)
            cost = np.where(np.isfinite(found.chi_square), found.chi_square, np.inf)
            order = np.lexsort((cost, owner))
            rank = np.arange(len(owner)) - np.searchsorted(owner[order], owner[order])
            chosen = np.sort(order[rank < kept])
            found = take(found, chosen)
            owner, x = owner[chosen], found.x
        assert found is not None
        return found

    def _look(self, rows: Rows, points: Array) -> Array:
        """The objective (trials, points) at points (trials, points, n), counted; infinite where there is none."""
        cost = np.full(points.shape[:2], np.inf)
        objective = self.whole(rows)
        for i in range(points.shape[1]):
            cost[:, i] = squared(objective.residual(points[:, i]))
        self.charge(rows, objective.model.tally)
        return np.where(np.isfinite(cost), cost, np.inf)


def _after(first: Minima, second: Minima) -> Minima:
    """The second of two minimisations, with the iterations and iterates of both."""
    history = second.history
    if first.history is not None and history is not None:
        history = [np.concatenate([a, b[1:]]) for a, b in zip(first.history, history, strict=True)]
    return replace(second, iterations=first.iterations + second.iterations, history=history)


_DAMPING = 1.0
"""lambda at the start of every window."""
_FIRST_ITERATIONS = 10
"""In each window of the first attempt."""
_SLOW_GROWTH = 1.4
_CAREFUL_ITERATIONS = (60, 30)
"""In the first window of a careful attempt, and in later ones."""
_FIRST_DRAWS = 16
_RANDOMISED = 2
"""In so many windows, which leave much open, the prior of a candidate is centred at its own start; in one more with
each attempt after the first from draws."""
_THINNING = (1, 1, 4, 8, 16, 32, 64)
"""Of the candidates that there were at the start, each window keeps the best one in so many; one at least."""
_GIVEN_UP = (np.inf, 1e6, 1e3)
"""The mean squared residual above which the fit of the first window, the second, and a later one is a wrong one, unless
the best fit of all data so far is as bad: then R may be wrong."""
_AS_BAD = 2.0
_ONE = (0.03, 0.003)
"""Candidates closer than this, in deviations of the prior, are one: in the first window, and later."""


@dataclass(frozen=True)
class Candidates:
    """Where the candidates of some trials have come; every field has the candidates in front."""

    x: Array
    start: Array
    """Where they began."""
    owner: Rows
    """The trial (candidates,) that each belongs to."""
    iterations: NDArray[np.int64]
    path: list[Array] | None
    """The iterates so far, where a history was asked for."""

    @classmethod
    def at(cls, x: Array, owner: Rows, history: bool) -> Candidates:
        return cls(x, x, owner, np.zeros(len(x), np.int64), [row[None] for row in x] if history else None)

    def moved(self, minima: Minima) -> Candidates:
        """The same candidates where a minimisation has led them."""
        path = self.path
        if path is not None and minima.history is not None:
            path = [np.concatenate([old, new[1:]]) for old, new in zip(path, minima.history, strict=True)]
        return replace(self, x=minima.x, iterations=self.iterations + minima.iterations, path=path)


@dataclass(frozen=True)
class Windows(Attempts):
    """By growing windows of data: from the nominal point, then carefully from there, then from 16, 32, ... 256 draws of
    the prior; among them, where a prior is known after the first draws, Levenberg-Marquardt on all data.

    The first two windows have about as many readings as there are parameters, so their fits have several minima of
    one depth, and a common prior would draw all candidates to one of them. Until then each candidate's prior is
    centred at its own draw, which makes the candidates about a sample of what the readings so far leave possible: the
    randomised maximum likelihood of Oliver, He and Reynolds (5th European Conference on the Mathematics of Oil
    Recovery, 1996). Where that fails, a minimum of the next window has drawn them all: so each later attempt keeps them
    apart for one window more.
    """

    planned: int = 9

    @property
    def _plain(self) -> int:
        """The first of the two attempts on all data."""
        return 2 if self.prior is None else 3

    def _rank(self, k: int) -> int:
        """The place of an attempt among those by windows: 0 and 1 from the nominal point, later ones from draws."""
        return k if k < self._plain else k - 2

    def draws(self, k: int) -> int:
        return 0 if 0 <= k - self._plain < 2 or k < 2 else _draws(self._rank(k))

    def attempt(self, k: int, rows: Rows, before: Minima | None) -> Minima:
        """A careful attempt without a prior takes one in its windows that reaches as far as the linear estimate
        says."""
        if 0 <= k - self._plain < 2:
            return self.plain(k - self._plain, rows)
        last, k = k == self.last, self._rank(k)
        if before is None or self.prior is not None or self.problem.rankless:
            return self._attempt(k, rows, before, last)
        result, reach = before, self._reach(rows)
        for size in np.unique(reach):
            there = reach == size
            search = replace(self, prior=np.full(self.problem.measurement.n, size))
            result = put(result, there, search._attempt(k, rows[there], take(before, there), last))
        return result

    def _reach(self, rows: Rows) -> Array:
        """How far the parameters of the trials `rows` may lie, where no prior says so: the median of the distances in
        the linear estimate, rounded up to a power of ten. On GINS that median is mostly right within a factor of three
        at any scale, and a prior ten times too wide does no harm."""
        tally = EvaluationCount.zeros(len(rows))
        x = starting_points(self.problem, self.z[rows], "linear_lse", tally)
        self.tally.simulations[rows] += tally.simulations
        distance = np.median(np.abs(x - self.problem.x0), axis=1)
        return 10.0 ** np.ceil(np.log10(np.clip(np.where(np.isfinite(distance), distance, 1.0), 1.0, 1e9)))

    def _attempt(self, k: int, rows: Rows, before: Minima | None, last: bool) -> Minima:
        """Window after window, then all data without the prior. Where none is known, draws reach as far as `before`."""
        prior = self.prior
        metric = np.ones(self.problem.measurement.n) if prior is None else prior
        there = self._begin(k, rows, metric if prior is not None or before is None else _reach(before, self.problem.x0))
        method = LevenbergMarquardtMethod(_DAMPING, metric, by_residual=k > 0, geodesic=k > 0)
        known = np.zeros(len(self.z))
        if before is not None:
            known[rows] = np.where(before.converged, _AS_BAD * before.chi_square / self.z.shape[1], 0.0)
        for number, (epochs, arrived) in enumerate(self._windows(k)):
            centre = there.start if number < self._randomised(k) else self.problem.x0
            objective = self._window(there.owner, epochs, arrived, centre)
            limit = _CAREFUL_ITERATIONS[min(number, 1)] if k else _FIRST_ITERATIONS
            minima = self.minimize(
                objective, there.owner, method, there.x, tolerance=self.limits.window_tolerance, limit=limit
            )
            fit = minima.chi_square if prior is None else minima.chi_square + _far(minima.x, centre, prior)
            per_reading = np.where(np.isfinite(fit), fit, np.inf) / objective.readings
            useless = np.maximum(known[there.owner], _GIVEN_UP[min(number, len(_GIVEN_UP) - 1)])
            kept = _kept(k, number, there.owner, minima.x / metric, per_reading, useless, last)
            there = take(there.moved(minima), kept)
        method = LevenbergMarquardtMethod(_DAMPING, metric)
        tolerance, limit = self.limits.tolerance, self.limits.max_iterations
        minima = self.minimize(self.whole(there.owner), there.owner, method, there.x, tolerance=tolerance, limit=limit)
        there = there.moved(minima)
        return self._best(rows, there, replace(minima, iterations=there.iterations, history=there.path))

    def _randomised(self, k: int) -> int:
        """In how many windows of the k-th attempt each candidate has its own prior."""
        return _RANDOMISED + max(0, k - 2)

    def _begin(self, k: int, rows: Rows, spread: Array) -> Candidates:
        """The nominal point twice, then draws about it."""
        x0, n = self.problem.x0, self.problem.measurement.n
        draws = np.zeros((1, n))
        if k > 1:
            draws = np.random.Generator(np.random.Philox(k)).standard_normal((_draws(k), n))
        spread = np.broadcast_to(spread, (len(rows), n))
        x = (x0 + spread[:, None] * draws).reshape(-1, n)
        return Candidates.at(x, np.repeat(rows, len(draws)), self.history)

    def _windows(self, k: int) -> Iterator[tuple[int, Rows]]:
        """Each window's number of epochs and its readings; all data are left to the last pass."""
        model = self.problem.measurement
        assert model.epochs is not None
        growth = min(self.limits.growth, _SLOW_GROWTH) if k else self.limits.growth
        for stop in window_stops(len(model.epochs), growth):
            yield stop, model.rows(stop)

    def _window(self, owner: Rows, epochs: int, arrived: Rows, centre: Array) -> Objective:
        """The objective of each candidate in a window, with the prior about `centre`."""
        problem, model = self.problem, self.problem.measurement
        assert model.epochs is not None
        window = CountingModel(
            SubsetModel.until(model, epochs, coarse=True), self.spent(owner), epochs / len(model.epochs)
        )
        R, z = problem.R.restricted(arrived), self.z[np.ix_(owner, arrived)]
        prior = None if self.prior is None else Covariance(self.prior)
        return Objective(window, R, z, np.arange(len(owner)), centre, prior).coarsened(0.0)

    def _best(self, rows: Rows, there: Candidates, minima: Minima) -> Minima:
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


def _kept(k: int, number: int, owner: Rows, x: Array, per_reading: Array, useless: Array, last: bool) -> Rows:
    """The candidates that go on after a window: of each trial the best few that differ and whose mean squared residual
    is not above `useless` (candidates,); one in any case in the `last` attempt, and where there is no fit at all: that
    ends with its own status."""
    most = max(1, _draws(k) // _THINNING[min(number, len(_THINNING) - 1)])
    if len(np.unique(owner)) == len(owner):  # nothing to choose among
        return np.flatnonzero((per_reading <= useless) | last | np.isinf(per_reading))
    order = np.lexsort((per_reading, owner))
    kept: list[int] = []
    for _, group in itertools.groupby(order.tolist(), key=lambda i: owner[i]):
        chosen: list[int] = []
        for i in group:
            alike = any(np.abs(x[i] - x[j]).max() <= _ONE[min(number, 1)] for j in chosen)
            good = per_reading[i] <= useless[i] or (not chosen and (last or np.isinf(per_reading[i])))
            if len(chosen) < most and good and not alike:
                chosen.append(i)
        kept += chosen
    return np.array(sorted(kept), dtype=np.intp)


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
