"""Progressive IPE: warm-started, re-linearised and damped, on a data window that grows as a filter sees the data."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.errors import UserError, require_counts, require_positive
from ipe_bench.basics.linalg import Array, Mask, finite
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.least_squares import Minima, Objective, minimize
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.base import Restricted
from ipe_bench.measurements.counted import Counted, Tally
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Progressive(Estimator):
    """The least-squares estimate, reached from far away.

    A short stretch of data is nearly linear in the parameters, so its fit is easy to find; it starts the fit of a
    window `growth` times as long, and so on to all data. In the windows the prior counts, as it does for a filter, and
    damps in its own metric, lambda |dx / prior_deviation|^2; Marquardt's scaling fails there, since an early window
    leaves some parameters nearly free. The last pass, on all data, is plain least squares without the prior.

    The chi-square test of the residuals is the estimator's own verdict, extras `fit_p`. A trial that fails it at
    `fit_level` is started again with windows that grow more slowly (the root of the growth each time), without the
    prior and damped in the metric of the parameters' own units; the best fit of all attempts counts.

    Without a prior (none known, or `use_prior: false`) the first attempt is already like that. Without epochs there are
    no windows: a pass with the prior, where there is one, then Levenberg-Marquardt with Marquardt's scaling on all
    data, restarted once with damping in the parameters' sizes and then from points around the nominal one.
    """

    growth: float = 2.0
    """Each window has about this many times the epochs of the one before; the first has one epoch."""
    use_prior: bool = True
    prior_inflation: float = 1.0
    """Times the prior's standard deviations."""
    damping: float = 1.0
    """lambda at the start of every window."""
    window_tolerance: float = 0.1
    """Where a window's fit is good enough: the Gauss-Newton step in standard deviations."""
    window_iterations: int = 10
    max_iterations: int = 60
    """Steps of the last pass."""
    tolerance: float = 1e-6
    """Of the last pass: the Gauss-Newton step in standard deviations of the local bound."""
    restarts: int = 3
    fit_level: float = 1e-6
    """Residuals less probable than this are taken for those of a wrong minimum."""
    budget: float | None = None
    """Simulations that a trial may cost, a Jacobian counting n and a window its share; None: no limit."""

    equation = "least_squares"

    def __post_init__(self) -> None:
        if not self.growth > 1:
            raise UserError(f"growth={self.growth}: give a number above 1")
        require_positive(self, "prior_inflation", "damping", "window_tolerance", "tolerance", "budget")
        require_counts(self, "window_iterations", "max_iterations")
        require_counts(self, "restarts", least=0)
        if not 0 <= self.fit_level < 1:
            raise UserError(f"fit_level={self.fit_level}: give a probability from 0 to below 1")

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        search = _Search(self, problem, z, Tally.zeros(len(z)), history)
        best = search.attempt(0, np.arange(len(z)))
        for k in range(1, self.restarts + 1):
            suspect = np.flatnonzero(self._suspect(best, search.tally, z))
            if not len(suspect):
                break
            again = search.attempt(k, suspect)
            better = _is_better(again, take(best, suspect))
            best = put(best, suspect[better], take(again, better))
        return best.estimates(search.tally, z.shape[1])

    def _suspect(self, best: Minima, tally: Tally, z: Array) -> Mask:
        """The trials that another attempt may help: (trials,)."""
        hopeless = ~finite(z) | tally.failed(np.arange(len(z)))
        affordable = tally.cost(best.x.shape[1]) < (np.inf if self.budget is None else self.budget)
        fits = best.converged & (best.fit_probability(z.shape[1]) >= self.fit_level)
        return ~fits & ~hopeless & affordable


@dataclass(frozen=True)
class _Search:
    """The attempts at one batch, which share its tally."""

    options: Progressive
    problem: Problem
    z: Array
    tally: Tally
    history: bool

    def attempt(self, k: int, rows: NDArray[np.intp]) -> Minima:
        """The k-th attempt for the trials `rows`: window after window, then all data."""
        options, problem = self.options, self.problem
        prior = problem.prior_used(options.prior_inflation) if options.use_prior and k == 0 else None
        in_windows = problem.measurement.epochs is not None
        method = LevenbergMarquardtMethod(options.damping, self._metric(k, prior))
        x = np.repeat(problem.x0[None] if in_windows else self._start(k)[None], len(rows), axis=0)
        passes: list[Minima] = []
        for objective in self._windows(k, rows, prior):
            passes.append(self._minimize(objective, method, x, options.window_tolerance, options.window_iterations))
            x = passes[-1].x
        whole = Objective(Counted(problem.measurement, self.tally), problem.R, self.z[rows], rows, problem.x0)
        passes.append(self._minimize(whole, method, x, options.tolerance, options.max_iterations))
        return _in_sequence(passes)

    def _windows(self, k: int, rows: NDArray[np.intp], prior: Array | None) -> Iterator[Objective]:
        """The objectives of the growing windows; all data are left to the last pass."""
        problem, model = self.problem, self.problem.measurement
        if model.epochs is None:
            if prior is not None:
                yield Objective(Counted(model, self.tally), problem.R, self.z[rows], rows, problem.x0, prior)
            return
        epochs = len(model.epochs)
        for stop in window_stops(epochs, self.options.growth ** (0.5**k)):
            arrived = model.rows(stop)
            window = Counted(Restricted.until(model, stop), self.tally, stop / epochs)
            z = self.z[np.ix_(rows, arrived)]
            yield Objective(window, problem.R.restricted(arrived), z, rows, problem.x0, prior)

    def _minimize(
        self, objective: Objective, method: LevenbergMarquardtMethod, x: Array, tolerance: float, limit: int
    ) -> Minima:
        return minimize(
            objective,
            method,
            x,
            tolerance=tolerance,
            max_iterations=limit,
            budget=self.options.budget,
            history=self.history,
        )

    def _metric(self, k: int, prior: Array | None) -> Array | None:
        """What damping measures steps by in attempt k; None: Marquardt's scaling."""
        if prior is not None:
            return prior
        problem = self.problem
        if problem.measurement.epochs is not None:
            return np.ones(problem.measurement.n)
        if k == 1:
            # The parameters' own sizes, scaled as a whole to the readings: this and Marquardt's fail in other places.
            return np.full(problem.measurement.n, 1.0 / np.linalg.norm(problem.R.whiten_jacobian(problem.H)))
        return None

    def _start(self, k: int) -> Array:
        """Where attempt k starts without windows: twice the nominal point, then points around it."""
        x0, deviation = self.problem.x0, self.problem.prior_deviation
        if k <= 1:
            return x0
        spread = deviation if deviation is not None else np.where(x0 == 0, 1.0, np.abs(x0))
        return x0 + spread * np.random.Generator(np.random.Philox(k)).standard_normal(len(x0))


def window_stops(epochs: int, growth: float) -> list[int]:
    """How many epochs each window has, the last one short of all: 1, 2, 4, 8, 16 of 30 for growth 2."""
    lengths = itertools.takewhile(lambda length: length < epochs, (growth**i for i in itertools.count()))
    return sorted({round(length) for length in lengths} - {epochs})


def _in_sequence(passes: list[Minima]) -> Minima:
    """The last pass, with the iterations and iterates of all of them."""
    history = None
    if passes[-1].history is not None:
        parts = zip(*(p.history for p in passes if p.history is not None), strict=True)
        history = [np.concatenate([first, *(rest[1:] for rest in later)]) for first, *later in parts]
    return replace(passes[-1], iterations=np.sum([p.iterations for p in passes], axis=0), history=history)


def _is_better(new: Minima, old: Minima) -> Mask:
    """Where a new attempt counts rather than the old one: it converged and fits better, or the old one had no end."""
    fits_better = ~(new.chi_square >= old.chi_square)
    return new.converged & (fits_better | ~old.converged)
