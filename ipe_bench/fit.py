"""Estimates from one set of real readings: values, standard errors, and whether the model fits them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ipe_bench.estimation import Estimator, estimate_safely
from ipe_bench.linalg import Array
from ipe_bench.measurements.base import Restricted
from ipe_bench.scenario import Problem
from ipe_bench.statuses import Status


@dataclass(frozen=True)
class Fit:
    """What one estimator makes of the readings."""

    label: str
    status: Status
    message: str
    x: Array
    """Estimates (n,) in physical units."""
    standard_errors: Array
    """(n,) in physical units, from the covariance that the estimator reports; NaN where it reports none."""
    residuals: Array
    """z - h(x) (m,), in the unit of the readings; NaN where the reading is missing."""
    chi_square: float
    """Sum of squares of the whitened residuals."""
    degrees_of_freedom: int
    """Readings that are there, less parameters."""
    simulations: float

    @property
    def residual_deviation(self) -> float:
        """Root of the residual sum of squares over the degrees of freedom, in the unit of the readings."""
        return float(np.sqrt(np.nansum(self.residuals**2) / self.degrees_of_freedom))

    @property
    def p_value(self) -> float:
        """Chance of a chi-square at least this large if the model and R are right: tiny means that they are not."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom))


def fit(problem: Problem, z: Array, estimators: Mapping[str, Estimator]) -> list[Fit]:
    """Lets every estimator loose on the readings z (m,), of which those that are NaN are missing."""
    present = np.flatnonzero(~np.isnan(z))
    given = problem if len(present) == len(z) else _restricted(problem, present)
    return [_fit_one(label, estimator, given, z[present], present, len(z)) for label, estimator in estimators.items()]


def _restricted(problem: Problem, rows: Array) -> Problem:
    model = Restricted(problem.measurement, tuple(rows.tolist()))
    return Problem(model, problem.R.restricted(rows), problem.prior_deviation)


def _fit_one(label: str, estimator: Estimator, problem: Problem, z: Array, rows: Array, m: int) -> Fit:
    model = problem.measurement
    estimates = estimate_safely(estimator, problem, z[None])
    with np.errstate(all="ignore"):
        try:
            r = z - model.simulate(estimates.x)[0]
        except Exception:
            r = np.full(len(z), np.nan)
    residuals = np.full(m, np.nan)
    residuals[rows] = r
    P = estimates.covariance
    errors = np.full(model.n, np.nan) if P is None else np.sqrt(np.diagonal(P[0])) * model.sizes
    return Fit(
        label,
        Status(int(estimates.status[0])),
        estimates.messages.get(0, ""),
        estimates.x[0] * model.sizes,
        errors,
        residuals,
        float(np.sum(problem.R.whiten(r) ** 2)),
        len(z) - model.n,
        float(estimates.simulations[0] + model.n * estimates.jacobians[0]),
    )
