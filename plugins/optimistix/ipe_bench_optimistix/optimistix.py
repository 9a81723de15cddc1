"""Nonlinear least squares by Optimistix, one trial at a time, on models that know nothing of
JAX."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from ipe_bench import Estimates, Estimator, Problem, Status
from ipe_bench.basics.linalg import Array, Covariance, pseudo_inverse
from ipe_bench.basics.options import Count, Positive
from ipe_bench.estimators.base import one_by_one
from ipe_bench.estimators.ipe import Start, starting_points
from ipe_bench.measurements.counted import EvaluationCount

jax.config.update("jax_enable_x64", True)
# A callback that waits for its arguments would wait for ever on few cores.
jax.config.update("jax_cpu_enable_async_dispatch", False)

_SOLVERS: dict[str, Any] = {
    "levenberg_marquardt": optimistix.LevenbergMarquardt,
    "dogleg": optimistix.Dogleg,
    "gauss_newton": optimistix.GaussNewton,
}


@dataclass(frozen=True)
class Optimistix(Estimator):
    """`optimistix.least_squares` (Rader, Lyons and Kidger, arXiv:2402.09983) on the whitened
    residuals, with the model's own Jacobian. Reports (J' J)^-1 of the whitened J.

    Optimistix scales nothing, so x is given to it in deviations of the linear bound. Its own rules
    end the search; the trial has converged if a Gauss-Newton step from there would be below
    `tolerance` deviations, else it has stalled.
    """

    method: Literal["levenberg_marquardt", "dogleg", "gauss_newton"] = "levenberg_marquardt"
    start: Start = "nominal"
    """Where the iteration begins: at the start, at the linear LSE, or at that of the two where the
    readings fit better (`best`)."""
    rtol: Positive = 1e-10
    """Relative change of x and of the residuals at which the search ends."""
    atol: Positive = 1e-10
    max_steps: Count = 256
    """After which the trial ends as max_iterations."""
    tolerance: Positive = 1e-4
    """Largest Gauss-Newton step still to go, in reported deviations, of a converged trial."""

    equation = "least_squares"

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        tally = EvaluationCount.zeros(len(z))
        x = starting_points(problem, z, self.start, tally)
        residuals = _Residuals(problem, z, tally)
        _readers[id(residuals)] = residuals
        try:
            with np.errstate(all="ignore"):
                return one_by_one(
                    range(len(z)), lambda t: self._search(residuals, t, x[t]), problem.measurement.n
                )
        finally:
            del _readers[id(residuals)]

    def _search(self, residuals: _Residuals, trial: int, x: Array) -> Estimates:
        """One trial, as a batch of one."""
        z, n = residuals.z[trial], len(x)
        if not np.isfinite(z).all():
            raise ValueError("a reading is not a finite number")
        found = optimistix.least_squares(
            _whitened(len(z), n),
            _SOLVERS[self.method](rtol=self.rtol, atol=self.atol),
            jnp.asarray((x - residuals.x0) / residuals.unit),
            args=jnp.array([id(residuals), trial]),
            max_steps=self.max_steps,
            throw=False,
        )
        end = residuals.x(found.value)
        status, P = self._judge(residuals, trial, end, found.result)
        return Estimates(
            x=end[None],
            status=np.array([status], dtype=np.int8),
            covariance=P,
            iterations=np.array([int(found.stats["num_steps"])], dtype=np.int64),
            simulations=residuals.tally.simulations[trial : trial + 1].copy(),
            jacobians=residuals.tally.jacobians[trial : trial + 1].copy(),
        )

    def _judge(
        self, residuals: _Residuals, trial: int, x: Array, result: Any
    ) -> tuple[Status, Array]:
        """The status and (J' J)^-1 (1, n, n) of where Optimistix ended."""
        J = residuals.J(x, trial)
        J_plus, deficient = pseudo_inverse(J[None], Covariance(np.ones(len(J))))
        P = np.matmul(J_plus, J_plus.swapaxes(1, 2))
        if not (np.isfinite(x).all() and np.isfinite(J).all()):
            return Status.NONFINITE, P
        if deficient[0]:
            return Status.SINGULAR, P
        if result == optimistix.RESULTS.nonlinear_max_steps_reached:
            return Status.MAX_ITERATIONS, P
        to_go = np.abs(J_plus[0] @ residuals.r(x, trial)) / np.sqrt(np.diag(P[0]))
        return (Status.CONVERGED if to_go.max() <= self.tolerance else Status.STALLED), P


_readers: dict[int, _Residuals] = {}
"""Who reads models now, by the number under which JAX's programs know them: so one program serves
all batches."""


@functools.cache
def _whitened(m: int, n: int) -> Any:
    """The whitened residuals (m,) of n parameters as a function that JAX compiles and
    differentiates."""

    @jax.custom_jvp
    def residuals(s: Any, of: Any) -> Any:
        return jax.pure_callback(_read, jax.ShapeDtypeStruct((m,), float), s, of)

    @residuals.defjvp
    def slope(at: Any, along: Any) -> Any:
        J = jax.pure_callback(_read_slopes, jax.ShapeDtypeStruct((m, n), float), *at)
        return residuals(*at), J @ along[0]

    return residuals


def _read(s: Any, of: Any) -> Array:
    reader, trial = (int(number) for number in np.asarray(of))
    return _readers[reader].r(_readers[reader].x(s), trial)


def _read_slopes(s: Any, of: Any) -> Array:
    reader, trial = (int(number) for number in np.asarray(of))
    return _readers[reader].J(_readers[reader].x(s), trial) * _readers[reader].unit


class _Residuals:
    """Whitened residuals of each trial and their slopes, counted."""

    def __init__(self, problem: Problem, z: Array, tally: EvaluationCount) -> None:
        self.problem, self.z, self.tally = problem, z, tally
        self.x0 = problem.x0
        H = problem.R.whiten_jacobian(problem.H[None])[0]
        deviations = np.sqrt(np.diag(np.linalg.pinv(H.T @ H)))
        self.unit = np.where(deviations > 0, deviations, 1.0)

    def x(self, s: Any) -> Array:
        return self.x0 + np.asarray(s) * self.unit

    def r(self, x: Array, trial: int) -> Array:
        self.tally.simulations[trial] += 1
        model, z = self.problem.measurement, self.z[trial]
        return self.problem.R.whiten(model.near(model.simulate(x[None])[0], z) - z)

    def J(self, x: Array, trial: int) -> Array:
        self.tally.jacobians[trial] += 1
        return np.ascontiguousarray(
            self.problem.R.whiten_jacobian(self.problem.measurement.jacobian(x[None]))[0]
        )
