"""Nonlinear least squares by SciPy, one trial at a time."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, doc

from ipe_bench.basics.errors import UserError, describe_exception
from ipe_bench.basics.linalg import Array, Covariance, pseudo_inverse
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Equation, Estimates, Estimator, one_by_one
from ipe_bench.estimators.ipe import Start, starting_points
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem

_OUT_OF_EVALUATIONS = 0
"""SciPy's status for it."""
_SCIPYS = ("method", "loss", "f_scale", "ftol", "xtol", "gtol", "max_nfev")
"""The options that are SciPy's own."""

Rounding = Annotated[float, Ge(float(np.finfo(float).eps)), doc("a number of at least 2.3e-16, the rounding of a 1")]


@dataclass(frozen=True)
class LeastSquares(Estimator):
    """`scipy.optimize.least_squares` on the whitened residuals, with the model's own Jacobian.

    Parameters are scaled by the columns of that Jacobian (x_scale="jac"). Reports (J' J)^-1 of the whitened J; with a
    robust loss, of the J that SciPy has reweighted for it. SciPy's own rules end the search; the trial has converged
    if a Gauss-Newton step from there would be below `tolerance` deviations, else it has stalled.
    """

    method: Literal["trf", "lm", "dogbox"] = "trf"
    """Trust region, MINPACK's Levenberg-Marquardt, or dogleg."""
    start: Start = "best"
    """The linear LSE, eq. (16), the nominal point, or that of the two where the readings fit better (`best`)."""
    loss: Literal["linear", "soft_l1", "huber", "cauchy", "arctan"] = "linear"
    """Anything but linear bounds what one bad reading can do; `lm` knows linear only."""
    f_scale: Positive = 1.0
    """The residual, in deviations of the reading, from which a robust loss begins to flatten."""
    ftol: Rounding = 1e-14
    """Relative decrease of the cost. At SciPy's 1e-8 the last step may still be a thousandth of a deviation."""
    xtol: Rounding = 1e-12
    gtol: Rounding = 1e-12
    max_nfev: Count | None = None
    """Evaluations of h after which the trial ends as max_iterations; None: SciPy's limit, 100 n."""
    tolerance: Positive = 1e-4
    """Largest Gauss-Newton step still to go, in reported deviations, of a converged trial. SciPy cannot promise less
    than about 1e-5: it watches the cost, which is flat there."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method == "lm" and self.loss != "linear":
            raise UserError(f"loss={self.loss}: method=lm knows loss=linear only; choose method=trf or dogbox")

    @property
    def equation(self) -> Equation | None:  # type: ignore[override]
        """A robust loss has roots of its own."""
        return "least_squares" if self.loss == "linear" else None

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        tally = EvaluationCount.zeros(len(z))
        x = starting_points(problem, z, self.start, tally)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            return one_by_one(
                zip(z, x, tally.simulations, strict=True),
                lambda trial: self._search(_Residuals(problem, *trial), history=history),
                problem.measurement.n,
            )

    def _search(self, residuals: _Residuals, *, history: bool) -> Estimates:
        """One trial, as a batch of one."""
        from scipy.optimize import least_squares

        jacobian: Any = residuals.J  # SciPy's stubs know its finite differences only
        options: Any = {name: getattr(self, name) for name in _SCIPYS}
        x, status, message, covariance = residuals.start, Status.NONFINITE, None, None
        try:
            if np.isfinite(residuals.r(x)).all():
                found = least_squares(residuals.r, x, jac=jacobian, x_scale="jac", **options)
                x = found.x
                status, covariance = self._judge(found)
            else:
                message = "a reading, or the model at the start, is not a finite number"
        except Exception as error:
            x, message = residuals.iterates[-1], describe_exception(error)
            status = Status.SINGULAR if isinstance(error, np.linalg.LinAlgError) else Status.ERROR
        if not np.array_equal(x, residuals.iterates[-1]):
            residuals.iterates.append(x)
        return Estimates(
            x=x[None],
            status=np.array([status], dtype=np.int8),
            covariance=np.full((1, len(x), len(x)), np.nan) if covariance is None else covariance,
            iterations=np.array([len(residuals.iterates) - 1], dtype=np.int64),
            simulations=np.array([residuals.simulations]),
            jacobians=np.array([residuals.jacobians]),
            messages={} if message is None else {0: message},
            history=[np.array(residuals.iterates)] if history else None,
        )

    def _judge(self, found: Any) -> tuple[Status, Array]:
        """The status and (J' J)^-1 (1, n, n) of where SciPy ended."""
        J_plus, deficient = pseudo_inverse(found.jac[None], Covariance(np.ones(len(found.jac))))
        P = np.matmul(J_plus, J_plus.swapaxes(1, 2))
        if not (np.isfinite(found.x).all() and np.isfinite(found.jac).all()):
            return Status.NONFINITE, P
        if deficient[0]:
            return Status.SINGULAR, P
        if found.status == _OUT_OF_EVALUATIONS:
            return Status.MAX_ITERATIONS, P
        to_go = np.abs(P[0] @ found.grad) / np.sqrt(np.diag(P[0]))
        return (Status.CONVERGED if to_go.max() <= self.tolerance else Status.STALLED), P


@dataclass
class _Residuals:
    """Whitened residuals of one trial and their slopes, as SciPy wants them, counted."""

    problem: Problem
    z: Array
    start: Array
    simulations: float
    jacobians: float = 0.0
    iterates: list[Array] = field(default_factory=list)
    """Where slopes were asked for: the start and every accepted step."""
    _last: tuple[Array, Array] | None = None

    def __post_init__(self) -> None:
        self.iterates.append(self.start)

    def r(self, x: Array) -> Array:
        if self._last is None or not np.array_equal(x, self._last[0]):
            self.simulations += 1
            h = self.problem.measurement.simulate(x[None])[0]
            self._last = x.copy(), self.problem.R.whiten(h - self.z)
        return self._last[1].copy()

    def J(self, x: Array) -> Array:
        self.jacobians += 1
        if not np.array_equal(x, self.iterates[-1]):
            self.iterates.append(x.copy())
        return self.problem.R.whiten_jacobian(self.problem.measurement.jacobian(x[None]))[0]
