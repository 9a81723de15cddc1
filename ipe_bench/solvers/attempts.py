"""Attempts at least squares from far away: by growing windows of data, and from other starts and
metrics."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Covariance, finite_or, repeated, squared
from ipe_bench.basics.streams import generator
from ipe_bench.estimators.driver import Limits, continued
from ipe_bench.estimators.ipe import starting_points
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Minima, minimize
from ipe_bench.measurements.base import Measurement, SubsetModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem

Rows = NDArray[np.intp]

# Halved or doubled, each plain number here and below leaves 155 of 160 trials solved, but for one
# fewer with half of `_LOOKS`, and the cost within 1 %: `python tests/benchmarks/constants.py
# attempts`. Few of those trials need a further attempt. `_SLOW_GROWTH` and tuples were not varied.
_LONG = 600
"""Iterations of an attempt from the start, and of one from elsewhere that promises
something."""
_PROMISING = 1e-3
"""The share by which a fit that has not converged must be better than the best one so far to
promise something."""


@dataclass(frozen=True)
class Attempts(ABC):
    """Makes the attempts at one batch z (trials, m), which share its tally."""

    problem: Problem
    prior: Array | None
    """The deviations (n,) of the prior that counts; None: there is none. Its correlations do not
    count: a search ends in a fit without the prior."""
    z: Array
    tally: EvaluationCount
    limits: Limits
    """The limits of a minimisation on all data."""
    growth: float
    window_tolerance: float
    restarts: int | None
    """See the options of `Progressive` of the same names."""

    planned: ClassVar[int]
    """The number of attempts."""
    repeats: ClassVar[int] = 1
    """The number of attempts that must lead to a minimum again for it to be believed, one at least
    from independent draws."""
    most: ClassVar[float] = np.inf
    """The most that a search which has tried draws may cost, in costs of a simulation and a
    Jacobian."""

    @property
    def last(self) -> int:
        """The number of the last attempt; the first is 0."""
        return self.planned - 1 if self.restarts is None else min(self.restarts, self.planned - 1)

    @abstractmethod
    def attempt(self, k: int, rows: Rows, before: Minima | None) -> Minima:
        """Makes the k-th attempt for the trials `rows`; `before` is the best of those so far."""

    @abstractmethod
    def draws(self, k: int) -> int:
        """Returns the number of independent draws that the k-th attempt begins from; 0 if it begins
        at the start or where the readings point."""

    def plain(self, k: int, rows: Rows) -> Minima:
        """Runs Levenberg-Marquardt on all data from the start: in the metric of the
        parameters' sizes (0), and in Marquardt's (1)."""
        method = (LevenbergMarquardtMethod(1.0, sizes=1.0), LevenbergMarquardtMethod(1e-3))[k]
        x = repeated(self.problem.x0, len(rows))
        return self.minimize(rows, method, x, max(_LONG, self.limits.max_iterations))

    def minimize(
        self,
        owner: Rows,
        method: LevenbergMarquardtMethod,
        x: Array,
        steps: int,
        objective: Objective | None = None,
        tolerance: float | None = None,
    ) -> Minima:
        """Minimises from x (candidates, n), on all data unless another objective is given, charged
        to the trials `owner` (candidates,)."""
        objective = self.whole(owner) if objective is None else objective
        tolerance = tolerance or self.limits.tolerance
        limits = replace(self.limits, max_iterations=steps, tolerance=tolerance)
        minima = minimize(objective, method, x, limits)
        self.charge(owner, objective.model.tally)
        return minima

    def whole(self, owner: Rows) -> Objective:
        """Makes the objective on all data for candidates of the trials `owner`."""
        model = self.counted(self.problem.measurement, owner)
        candidates = np.arange(len(owner))
        return Objective(model, self.problem.R, self.z[owner], candidates, self.problem.x0)

    def counted(self, measurement: Measurement, owner: Rows, share: float = 1.0) -> CountingModel:
        """Makes a model for candidates of the trials `owner`, whose tally begins at what each trial
        has cost so far."""
        return CountingModel(measurement, self.tally.copied(owner), share)

    def charge(self, owner: Rows, tally: EvaluationCount) -> None:
        """Adds to each trial what its candidates have cost since they were `counted`."""
        for name in ("simulations", "jacobians", "reported"):
            total = getattr(self.tally, name)
            np.add.at(total, owner, getattr(tally, name) - total[owner])
        for candidate, message in tally.messages.items():
            self.tally.messages.setdefault(int(owner[candidate]), message)


_FROM_AFAR = LevenbergMarquardtMethod(1e-2, sizes=1e-3)
_SHORT = 60
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
_HALVINGS = ((5, 5), (15, 2), (_SHORT, 1))
"""Steps from each of these starts, and how many of them are kept."""


@dataclass(frozen=True)
class Stages(Attempts):
    """Attempts fits on all data from other starts, for models without epochs.

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
            found = self._halved(k, rows)
        else:
            steps = max(_SHORT, self.limits.max_iterations)
            found = self.minimize(rows, _FROM_AFAR, self._start(k, rows), steps)
        lower = found.chi_square < before.chi_square * (1 - _PROMISING)
        promising = ~found.converged & lower
        if promising.any():
            first = take(found, promising)
            steps = max(_LONG, self.limits.max_iterations)
            on = self.minimize(rows[promising], _FROM_AFAR, first.x, steps)
            found = put(found, promising, continued(first, on))
        return found

    def _start(self, k: int, rows: Rows) -> Array:
        """Chooses the best of the points on the ray, in attempt 3 the best that is not about the
        same, and later the best of 20 random points."""
        x0 = self.problem.x0
        if k >= _RANDOM:
            points = self._points(k if k < min(_HALVING) else k - 1)
        else:
            direction = x0 if x0.any() else np.ones(len(x0))
            points = np.multiply.outer(_RAYS, direction)
        cost = self._look(rows, points)
        chosen = np.argmin(cost, axis=1)
        if k == 3:
            best = _RAYS[chosen][:, None]
            same_side = np.sign(best) == np.sign(_RAYS)
            decades = np.abs(np.log10(np.abs(_RAYS / best)))
            alike = same_side & (decades < _APART)
            chosen = np.argmin(np.where(alike, np.inf, cost), axis=1)
        return points[chosen]

    def _points(self, k: int, *, wide: bool = False) -> Array:
        """Draws 20 random points (20, n): of any size in the quadrant of the start or one
        nearby (`wide`), which a prior that is too narrow does not hinder; else of the prior if one
        is known, of any sign (k even), or about the start."""
        x0 = self.problem.x0
        shape = (_LOOKS, len(x0))
        rng = generator(k)
        if wide:
            turned = np.where(rng.uniform(size=shape) < 0.8, 1.0, -1.0)
            sign = turned * np.where(x0 < 0, -1.0, 1.0)
            return sign * 10 ** rng.normal(0.0, 1.0, shape)
        if self.prior is not None:
            return x0 + self.prior * rng.standard_normal(shape)
        if k % 2 == 0:
            return 10 ** rng.uniform(-2, 0.5, shape) * rng.choice([-1.0, 1.0], shape)
        factor = 10 ** rng.uniform(-2.5, 0.5, (_LOOKS, 1))
        return factor * (x0 + 0.5 * rng.standard_normal(shape))

    def _halved(self, k: int, rows: Rows) -> Minima:
        """Starts from 20 wide draws and drops the worst after few steps: how well a start fits says
        little."""
        owner = np.repeat(rows, _LOOKS)
        x = np.tile(self._points(k, wide=True), (len(rows), 1))
        found = Minima.nowhere(x, self.limits.history)
        for steps, kept in _HALVINGS:
            found = continued(found, self.minimize(owner, _FROM_AFAR, found.x, steps))
            useless = np.full(len(owner), np.inf)
            chosen = _kept(owner, found.x, finite_or(np.inf, found.chi_square), useless, most=kept)
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
    | 2, 3; 3, 4 | the start, on all data, as attempts 0 and 1 of `Stages` |
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
        prior = self.prior
        epochs = self.problem.measurement.epochs
        assert epochs is not None
        start = self._starts(k, rows, before)
        owner = np.repeat(rows, _draws(k))
        found = Minima.nowhere(start, self.limits.history)
        metric = np.ones(start.shape[1]) if prior is None else prior
        method = LevenbergMarquardtMethod(_DAMPING, metric, by_residual=k > 0, geodesic=k > 0)
        # The mean squared residual up to which a window's fit is no worse than the best so far.
        known = np.zeros(len(self.z))
        if before is not None:
            as_bad = _AS_BAD * before.chi_square / self.z.shape[1]
            known[rows] = np.where(before.converged, as_bad, 0.0)
        growth = min(self.growth, _SLOW_GROWTH) if k else self.growth
        for number, stop in enumerate(window_stops(len(epochs), growth)):
            centre = start if number < _RANDOMISED + max(0, k - 2) else self.problem.x0
            objective = self._window(owner, stop, centre)
            steps = _CAREFUL_ITERATIONS[min(number, 1)] if k else _FIRST_ITERATIONS
            minima = self.minimize(owner, method, found.x, steps, objective, self.window_tolerance)
            fit = minima.chi_square
            if prior is not None:
                fit = fit + np.sum(((minima.x - centre) / prior) ** 2, axis=1)
            kept = _kept(
                owner,
                minima.x / metric,
                finite_or(np.inf, fit) / objective.readings,
                useless=np.maximum(known[owner], _GIVEN_UP[min(number, 2)]),
                most=max(1, _draws(k) // _THINNING[min(number, 6)]),
                alike=_ONE[min(number, 1)],
                last=last,
            )
            found = take(continued(found, minima), kept)
            start = start[kept]
            owner = owner[kept]
        method = LevenbergMarquardtMethod(_DAMPING, metric)
        found = continued(found, self.minimize(owner, method, found.x, self.limits.max_iterations))
        return self._best(rows, owner, found)

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


def _kept(
    owner: Rows,
    x: Array,
    fit: Array,
    useless: Array,
    *,
    most: int,
    alike: float = -1.0,
    last: bool = False,
) -> Rows:
    """Selects the candidates that go on: of each trial the best few that are not alike and whose
    `fit` (candidates,) is not above `useless` (candidates,); one in any case in the `last` attempt,
    and where there is no fit at all: that ends with its own status."""
    # There is nothing to choose among.
    if len(np.unique(owner)) == len(owner):
        return np.flatnonzero((fit <= useless) | last | np.isinf(fit))
    kept: list[int] = []
    best_first = np.lexsort((fit, owner)).tolist()
    for _, group in itertools.groupby(best_first, key=lambda i: owner[i]):
        chosen: list[int] = []
        for i in group:
            in_any_case = not chosen and (last or np.isinf(fit[i]))
            if len(chosen) == most or not (fit[i] <= useless[i] or in_any_case):
                continue
            if not any(np.abs(x[i] - x[j]).max() <= alike for j in chosen):
                chosen.append(i)
        kept += chosen
    return np.array(sorted(kept), dtype=np.intp)


def _draws(k: int) -> int:
    """Returns the number of candidates that the k-th attempt by windows begins with."""
    return _FIRST_DRAWS * 2 ** (k - 2) if k > 1 else 1


def window_stops(epochs: int, growth: float) -> list[int]:
    """Computes the number of epochs of each window, the last one short of all: 1, 2, 4, 8, 16 of 30
    for growth 2."""
    growing = (growth**i for i in itertools.count())
    lengths = itertools.takewhile(lambda length: length < epochs, growing)
    return sorted({round(length) for length in lengths} - {epochs})
