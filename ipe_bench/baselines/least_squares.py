"""Least squares on all readings at once: the linear estimate, Gauss-Newton, and variants of Levenberg-Marquardt."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite
from ipe_bench.basics.options import Count, Positive, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import Limits, Solver
from ipe_bench.estimators.ipe import Start, begin, starting_points
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Objective
from ipe_bench.estimators.levenberg_marquardt import GaussNewtonMethod, LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Fitting, Minima, minimize, passes, spread_of_starts
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class LinearLSE(Estimator):
    """x = x0 + H+ (z - h(x0)), eq. (2): takes the measurement for linear. Reports (H' R^-1 H)^-1, eq. (5)."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        x, system = begin(problem, z, "linear_lse")
        return Estimates(
            x=x,
            status=np.where(finite(x), Status.CONVERGED, Status.NONFINITE).astype(np.int8),
            covariance=np.repeat(system.covariance(), len(z), axis=0),
            simulations=system.model.tally.simulations,
            history=[np.stack([problem.x0, row]) for row in x] if history else None,
        )


@dataclass(frozen=True)
class Batch(Estimator):
    """Least squares by an iteration; a subclass says what is minimised, and by which method."""

    start: Start = "nominal"
    """Where the iteration begins: at the linear LSE, eq. (16), at the nominal point, or at that of the two where the
    readings fit better (`best`)."""
    max_iterations: Count = 100
    """Steps tried."""
    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step in standard deviations of the local bound: the gradient in whitened units."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation: ClassVar = "least_squares"

    def objective(self, problem: Problem, z: Array) -> Objective:
        """What is minimised for readings z (trials, m)."""
        return Objective.of(problem, z, prior=False)

    @abstractmethod
    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        """What minimises it."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = self.objective(problem, z)
        tally = objective.model.tally
        x = starting_points(problem, z, self.start, tally)
        limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
        return minimize(objective, self.method(objective), x, limits).estimates(tally, z.shape[1])


@dataclass(frozen=True)
class GaussNewton(Batch):
    """x <- x - (J' R^-1 J)^-1 J' R^-1 (h(x) - z), undamped unless `damping` is given: fast near the minimum, and lost
    where the model is not nearly linear between start and minimum."""

    start: Start = "linear_lse"
    damping: Positive | None = None
    """The initial lambda of Levenberg-Marquardt with Marquardt's scaling; None: no damping."""

    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        return GaussNewtonMethod() if self.damping is None else LevenbergMarquardtMethod(self.damping)


@dataclass(frozen=True)
class LevenbergMarquardt(Batch):
    """Gauss-Newton whose step is kept short, with Marquardt's scaling, as long as the fit does not improve as predicted
    (Marquardt, J. SIAM 11, 1963; More, LNM 630, 1978)."""

    damping: Positive = 1e-3
    """lambda at the start."""
    geodesic: bool = False
    """Bends each step along the curvature of the readings, for one more simulation (Transtrum and Sethna, 2012,
    arXiv 1201.5885)."""

    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        return LevenbergMarquardtMethod(self.damping, geodesic=self.geodesic)


@dataclass(frozen=True)
class MapLM(Batch):
    """The maximum a posteriori: least squares with the scenario's prior as further readings, by Levenberg-Marquardt
    damped in the metric of the prior. It is the batch answer that a filter with the same prior should equal.

    Reports (J' R^-1 J + P0^-1)^-1.
    """

    damping: Positive = 1.0
    """lambda at the start."""
    prior_inflation: Positive = 1.0
    """Times the prior's standard deviations."""

    needs = frozenset({"prior"})
    equation = "map"

    def objective(self, problem: Problem, z: Array) -> Objective:
        return Objective.of(problem, z, prior=True, inflation=self.prior_inflation)

    def method(self, objective: Objective) -> Solver[LeastSquaresSystem]:
        return LevenbergMarquardtMethod(self.damping, None if objective.prior is None else objective.prior.deviations)


@dataclass(frozen=True)
class MultiscaleLM(Estimator):
    """Least squares for hard starts: minimised twice from the nominal point, and the lower minimum kept.

    Marquardt's scaling (column norms of J, growing) may run along a parameter that the readings hardly see at the
    start; parameters in multiples of their size do not, but fail where one ends far from its size. Costs about twice as
    much as one Levenberg-Marquardt.
    """

    max_iterations: Count = 1000
    """Of each of the two minimisations."""
    tolerance: Positive = 1e-10
    """Largest Gauss-Newton step in standard deviations of the local bound."""
    damping: Positive = 1e-4
    """The first damping factor, relative to the squared norm of J."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z, prior=False)
        size = np.full(len(problem.x0), 1.0 / np.linalg.norm(problem.R.whiten_jacobian(problem.H)))
        start = np.repeat(problem.x0[None], len(z), axis=0)
        limits = Limits(self.tolerance, self.max_iterations, history=history)
        methods = (LevenbergMarquardtMethod(self.damping, metric) for metric in (size, None))
        by_size, by_columns = (minimize(objective, method, start, limits) for method in methods)
        costs = [np.where(np.isfinite(m.chi_square), m.chi_square, np.inf) for m in (by_size, by_columns)]
        # The first where they fit alike to round-off; without a finite fit anywhere it keeps its status.
        improves = costs[1] < costs[0] * (1 - 1e-12)
        best = put(by_size, improves, take(by_columns, improves))
        best = replace(best, iterations=by_size.iterations + by_columns.iterations)
        return best.estimates(objective.model.tally, z.shape[1])


@dataclass(frozen=True)
class Multistart(Estimator):
    """Levenberg-Marquardt from the nominal point, then from draws of the prior, until the residuals pass the
    chi-square test; of all minima the lowest counts (Boender and Rinnooy Kan, Mathematical Programming 37, 1987).

    After the first fit `confirmations` further starts look for another minimum that fits. Extras: `minima`, how many
    distinct minima that fit were found, and `ambiguous`, 1 where there are several; `alternatives` lists the others.
    Damping is in the metric of the prior. Without a prior it is in Marquardt's, and starts are spread by the size of
    the nominal point.
    """

    starts: Count = 8
    confirmations: Whole = 2
    """Starts after the first fit, within `starts`."""
    damping: Positive = 1e-3
    """lambda at each start."""
    max_iterations: Count = 100
    """Steps tried from each start."""
    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step in standard deviations of the local bound."""
    seed: Whole = 0
    """A trial's random stream depends on this and on its readings: on nothing else in the batch."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z, prior=False)
        tally, x0, trials = objective.model.tally, problem.x0, len(z)
        draws = normals(own_generators(self.seed, z), self.starts - 1, len(x0))
        fitting = Fitting.none(trials, z.shape[1])

        def fits(found: Minima, rows: NDArray[np.intp]) -> Mask:
            """Which minima are believed; those that fit are noted."""
            return fitting.note(found, rows) & passes(found, z.shape[1], problem.doubted)

        best = self._descend(objective, problem, np.repeat(x0[None], trials, axis=0), history)
        confirmed = np.where(fits(best, np.arange(trials)), 0, -1)
        for k in range(self.starts - 1):
            affordable = tally.cost(len(x0)) < (np.inf if self.budget is None else self.budget)
            hopeless = ~finite(z) | tally.failed(np.arange(trials))
            rows = np.flatnonzero((confirmed < self.confirmations) & affordable & ~hopeless)
            if not len(rows):
                break
            x = x0 + spread_of_starts(problem) * draws[rows, k]
            again = self._descend(objective.subset(rows), problem, x, history)
            confirmed[rows] += (confirmed[rows] >= 0) | fits(again, rows)
            best = best.replaced(rows, again, again.better_than(take(best, rows)))
        return fitting.report(best.estimates(tally, z.shape[1]))

    def _descend(self, objective: Objective, problem: Problem, x: Array, history: bool) -> Minima:
        method = LevenbergMarquardtMethod(self.damping, problem.prior_used())
        return minimize(objective, method, x, Limits(self.tolerance, self.max_iterations, self.budget, history))
