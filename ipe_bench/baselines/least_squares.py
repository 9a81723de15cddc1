"""Fits all readings at once: the linear estimate, Gauss-Newton, Levenberg-Marquardt, and SciPy's
own methods."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, doc
from numpy.typing import NDArray

from ipe_bench.basics.batches import take
from ipe_bench.basics.errors import UserError, describe_exception
from ipe_bench.basics.linalg import (
    Array,
    Covariance,
    Mask,
    deviations,
    finite,
    finite_or,
    from_root,
    pseudo_inverse,
    repeated,
)
from ipe_bench.basics.options import Count, Positive, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.estimators.base import Equation, Estimates, Estimator, one_by_one
from ipe_bench.estimators.driver import Limits, Method
from ipe_bench.estimators.ipe import Start, begin, starting_points
from ipe_bench.estimators.least_squares import LeastSquaresSystem, Objective
from ipe_bench.estimators.levenberg_marquardt import GaussNewtonMethod, LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Fitting, Minima, minimize, passes, spread_of_starts
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem

_OUT_OF_EVALUATIONS = 0
"""SciPy's status for it."""
_SCIPYS = ("method", "loss", "f_scale", "ftol", "xtol", "gtol", "max_nfev")
"""The options that are SciPy's own."""

Rounding = Annotated[
    float, Ge(float(np.finfo(float).eps)), doc("a number of at least 2.3e-16, the rounding of a 1")
]


@dataclass(frozen=True)
class LinearLSE(Estimator):
    r"""Takes the measurement for linear, eq. (2), and reports the covariance of eq. (5).

    .. math:: x = x_0 + H^+ \left( z - h(x_0) \right), \quad H^+ = (H^T R^{-1} H)^{-1} H^T R^{-1}

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=0.1)
    >>> table = ib.run(bench, {"linear_lse": ib.baselines.LinearLSE()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        x, system = begin(problem, z, "linear_lse")
        status = np.where(finite(x), Status.CONVERGED, Status.NONFINITE)
        return Estimates(
            x=x,
            status=status.astype(np.int8),
            covariance=np.repeat(system.covariance(), len(z), axis=0),
            simulations=system.model.tally.simulations,
            history=[np.stack([problem.x0, row]) for row in x] if history else None,
        )


@dataclass(frozen=True)
class Batch(Estimator):
    """Minimises least squares iteratively; a subclass states the objective and the method."""

    start: Start = "nominal"
    """Where the iteration begins: at the linear LSE, eq. (16), at the model's start (`nominal`),
    or at the one of the two where the readings fit better (`best`)."""
    max_iterations: Count = 100
    """Steps tried."""
    tolerance: Positive = 1e-6
    """Largest Gauss-Newton step in standard deviations of the local bound: the gradient in whitened
    units."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation: ClassVar = "least_squares"

    def objective(self, problem: Problem, z: Array) -> Objective:
        """Returns the objective for readings z (trials, m)."""
        return Objective.of(problem, z)

    @abstractmethod
    def method(self, objective: Objective) -> Method[Objective, LeastSquaresSystem]:
        """Returns the method that minimises it."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = self.objective(problem, z)
        tally = objective.model.tally
        x = starting_points(problem, z, self.start, tally)
        limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
        return minimize(objective, self.method(objective), x, limits).estimates(tally, z.shape[1])


@dataclass(frozen=True)
class GaussNewton(Batch):
    """Iterates x <- x - (J' R^-1 J)^-1 J' R^-1 (h(x) - z), undamped unless `damping` is given: fast
    near the minimum, and lost where the model is not nearly linear between start and minimum.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> method = ib.baselines.GaussNewton(start="nominal")
    >>> table = ib.run(bench, {"gauss_newton": method}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    start: Start = "linear_lse"
    damping: Positive | None = None
    """The initial lambda of Levenberg-Marquardt with Marquardt's scaling; None: no damping."""

    def method(self, objective: Objective) -> Method[Objective, LeastSquaresSystem]:
        if self.damping is None:
            return GaussNewtonMethod()
        return LevenbergMarquardtMethod(self.damping)


@dataclass(frozen=True)
class LevenbergMarquardt(Batch):
    """Shortens Gauss-Newton steps, in Marquardt's scaling, as long as the fit does not improve as
    predicted (Marquardt, J. SIAM 11, 1963; More, LNM 630, 1978).

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> method = ib.baselines.LevenbergMarquardt(geodesic=True)
    >>> table = ib.run(bench, {"geodesic_lm": method}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    damping: Positive = 1e-3
    """lambda at the start."""
    geodesic: bool = False
    """Bends each step along the curvature of the readings, for one more simulation (Transtrum and
    Sethna, 2012, arXiv 1201.5885)."""

    def method(self, objective: Objective) -> Method[Objective, LeastSquaresSystem]:
        return LevenbergMarquardtMethod(self.damping, geodesic=self.geodesic)


@dataclass(frozen=True)
class MapLM(Batch):
    """Maximises the posterior: least squares with the scenario's prior as further readings, by
    Levenberg-Marquardt damped in the metric of the prior. It is the batch answer that a filter with
    the same prior should equal.

    Reports (J' R^-1 J + P0^-1)^-1.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"map_lm": ib.baselines.MapLM(prior_inflation=2.0)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    damping: Positive = 1.0
    """lambda at the start."""
    prior_inflation: Positive = 1.0
    """Times the prior's standard deviations."""

    needs = frozenset({"prior"})
    equation = "map"

    def objective(self, problem: Problem, z: Array) -> Objective:
        return Objective.of(problem, z, self.prior_inflation)

    def method(self, objective: Objective) -> Method[Objective, LeastSquaresSystem]:
        metric = objective.prior and objective.prior.deviations
        return LevenbergMarquardtMethod(self.damping, metric)


@dataclass(frozen=True)
class MultiscaleLM(Estimator):
    """Minimises least squares where it is hard to begin: twice from the start, keeping the lower
    minimum.

    Marquardt's scaling (column norms of J, growing) may run along a parameter that the readings
    hardly see at the start; parameters in multiples of their size do not, but fail where one ends
    far from its size. Costs about twice as much as one Levenberg-Marquardt.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"multiscale_lm": ib.baselines.MultiscaleLM()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    max_iterations: Count = 1000
    """Steps tried in each of the two minimisations."""
    tolerance: Positive = 1e-10
    """Largest Gauss-Newton step in standard deviations of the local bound."""
    damping: Positive = 1e-4
    """The first damping factor, relative to the squared norm of J."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z)
        length = np.linalg.norm(problem.R.whiten_jacobian(problem.H))
        size = np.full(len(problem.x0), 1.0 / length)
        start = repeated(problem.x0, len(z))
        limits = Limits(self.tolerance, self.max_iterations, history=history)
        methods = (LevenbergMarquardtMethod(self.damping, metric) for metric in (size, None))
        by_size, by_columns = (minimize(objective, method, start, limits) for method in methods)
        both = (by_size.chi_square, by_columns.chi_square)
        costs = [finite_or(np.inf, cost) for cost in both]
        # The first where they fit alike to round-off; without a finite fit anywhere it keeps its
        # status.
        best = by_size.replaced(np.arange(len(z)), by_columns, costs[1] < costs[0] * (1 - 1e-12))
        return best.estimates(objective.model.tally, z.shape[1])


@dataclass(frozen=True)
class Multistart(Estimator):
    """Runs Levenberg-Marquardt from the start, then from draws of the prior, until the
    residuals pass the chi-square test; of all minima the lowest counts (Boender and Rinnooy Kan,
    Mathematical Programming 37, 1987).

    After the first fit `confirmations` further starts look for another minimum that fits. Extras:
    `minima`, how many distinct minima that fit were found, and `ambiguous`, 1 where there are
    several; `alternatives` lists the others. Damping is in the metric of the prior. Without a prior
    it is in Marquardt's, and the draws are spread by the size of the start.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"multistart": ib.baselines.Multistart(starts=4)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
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
    """Seed of a trial's random stream, which depends on this and on the trial's readings alone."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        objective = Objective.of(problem, z)
        tally = objective.model.tally
        x0 = problem.x0
        trials = len(z)
        draws = normals(own_generators(self.seed, z), self.starts - 1, len(x0))
        fitting = Fitting.none(trials, z.shape[1])
        method = LevenbergMarquardtMethod(self.damping, problem.prior_used())
        limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
        budget = np.inf if self.budget is None else self.budget

        def believed(found: Minima, rows: NDArray[np.intp]) -> Mask:
            """Tells which minima are believed, and notes those that fit."""
            return fitting.note(found, rows) & passes(found, z.shape[1], problem.doubted)

        best = minimize(objective, method, repeated(x0, trials), limits)
        # Starts since the first fit; -1 before it.
        confirmed = np.where(believed(best, np.arange(trials)), 0, -1)
        for k in range(self.starts - 1):
            affordable = tally.of_search(len(x0)) < budget
            hopeless = ~finite(z) | tally.failed(np.arange(trials))
            rows = np.flatnonzero((confirmed < self.confirmations) & affordable & ~hopeless)
            if not len(rows):
                break
            x = x0 + spread_of_starts(problem) * draws[rows, k]
            again = minimize(objective.subset(rows), method, x, limits)
            confirmed[rows] += (confirmed[rows] >= 0) | believed(again, rows)
            best = best.replaced(rows, again, again.better_than(take(best, rows)))
        return fitting.report(best.estimates(tally, z.shape[1]))


@dataclass(frozen=True)
class LeastSquares(Estimator):
    """Minimises whitened residuals by `scipy.optimize.least_squares`, with the model's own
    Jacobian.

    Parameters are scaled by the columns of that Jacobian (x_scale="jac"). Reports (J' J)^-1 of the
    whitened J; with a robust loss, of the J that SciPy has reweighted for it. SciPy's own rules end
    the search; the trial has converged if a Gauss-Newton step from there would be below `tolerance`
    deviations, else it has stalled.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"dogbox": ib.baselines.LeastSquares(method="dogbox")}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    method: Literal["trf", "lm", "dogbox"] = "trf"
    """Trust region, MINPACK's Levenberg-Marquardt, or dogleg."""
    start: Start = "best"
    """Where the iteration begins: at the linear LSE, eq. (16), at the model's start (`nominal`),
    or at the one of the two where the readings fit better (`best`)."""
    loss: Literal["linear", "soft_l1", "huber", "cauchy", "arctan"] = "linear"
    """Anything but linear bounds what one bad reading can do; `lm` knows linear only."""
    f_scale: Positive = 1.0
    """The residual, in deviations of the reading, from which a robust loss begins to flatten."""
    ftol: Rounding = 1e-14
    """Relative decrease of the cost. At SciPy's 1e-8 the last step may still be a thousandth of a
    deviation."""
    xtol: Rounding = 1e-12
    gtol: Rounding = 1e-12
    max_nfev: Count | None = None
    """Evaluations of h after which the trial ends as max_iterations; None: SciPy's limit, 100 n."""
    tolerance: Positive = 1e-4
    """Largest Gauss-Newton step still to go, in reported deviations, of a converged trial. SciPy
    cannot promise less than about 1e-5: it watches the cost, which is flat there."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method == "lm" and self.loss != "linear":
            raise UserError(
                f"loss={self.loss}: method=lm takes only loss=linear; choose method=trf or dogbox"
            )

    @property
    def equation(self) -> Equation | None:  # type: ignore[override]
        """A robust loss has roots of its own."""
        return "least_squares" if self.loss == "linear" else None

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        tally = EvaluationCount.zeros(len(z))
        x = starting_points(problem, z, self.start, tally)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            given = zip(z, x, tally.simulations, strict=True)
            trials = [_Residuals(problem, *trial) for trial in given]
            search = partial(self._search, history=history)
            return one_by_one(trials, search, problem.measurement.n)

    def _search(self, residuals: _Residuals, *, history: bool) -> Estimates:
        """Runs one trial, as a batch of one."""
        from scipy.optimize import least_squares

        jacobian: Any = residuals.J  # SciPy's stubs know its finite differences only
        options: Any = {name: getattr(self, name) for name in _SCIPYS}
        x = residuals.start
        covariance = np.full((1, len(x), len(x)), np.nan)
        status = Status.NONFINITE
        message = "a reading, or the model at the start, is not a finite number"
        try:
            if np.isfinite(residuals.r(x)).all():
                found = least_squares(residuals.r, x, jac=jacobian, x_scale="jac", **options)
                x = found.x
                message = ""
                status, covariance = self._judge(found)
        except Exception as error:
            x = residuals.iterates[-1]
            message = describe_exception(error)
            singular = isinstance(error, np.linalg.LinAlgError)
            status = Status.SINGULAR if singular else Status.ERROR
        if not np.array_equal(x, residuals.iterates[-1]):
            residuals.iterates.append(x)
        return Estimates(
            x=x[None],
            status=np.array([status], dtype=np.int8),
            covariance=covariance,
            iterations=np.array([len(residuals.iterates) - 1], dtype=np.int64),
            simulations=np.array([residuals.simulations]),
            jacobians=np.array([residuals.jacobians]),
            messages={0: message} if message else {},
            history=[np.array(residuals.iterates)] if history else None,
        )

    def _judge(self, found: Any) -> tuple[Status, Array]:
        """Returns the status and (J' J)^-1 (1, n, n) at SciPy's end."""
        white = Covariance(np.ones(len(found.jac)))
        J_plus, deficient = pseudo_inverse(found.jac[None], white)
        P = from_root(J_plus)
        if not (np.isfinite(found.x).all() and np.isfinite(found.jac).all()):
            return Status.NONFINITE, P
        if deficient[0]:
            return Status.SINGULAR, P
        if found.status == _OUT_OF_EVALUATIONS:
            return Status.MAX_ITERATIONS, P
        # The Gauss-Newton step P J'r, in deviations.
        to_go = np.abs(P[0] @ found.grad) / deviations(P[0])
        return (Status.CONVERGED if to_go.max() <= self.tolerance else Status.STALLED), P


@dataclass
class _Residuals:
    """Computes whitened residuals of one trial and their slopes, as SciPy wants them, counted."""

    problem: Problem
    z: Array
    start: Array
    simulations: float
    jacobians: float = 0.0
    _last: tuple[Array, Array] | None = None

    @cached_property
    def iterates(self) -> list[Array]:
        """The points at which slopes were asked for: the start and every accepted step."""
        return [self.start]

    def r(self, x: Array) -> Array:
        if self._last is None or not np.array_equal(x, self._last[0]):
            self.simulations += 1
            model = self.problem.measurement
            h = model.near(model.simulate(x[None])[0], self.z)
            self._last = x.copy(), self.problem.R.whiten(h - self.z)
        return self._last[1].copy()

    def J(self, x: Array) -> Array:
        self.jacobians += 1
        if not np.array_equal(x, self.iterates[-1]):
            self.iterates.append(x.copy())
        J = self.problem.measurement.jacobian(x[None])
        return self.problem.R.whiten_jacobian(J)[0]
