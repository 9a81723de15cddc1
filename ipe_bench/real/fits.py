"""Estimates from one set of real readings: values, standard errors, and whether the model fits them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimator, estimate_safely
from ipe_bench.measurements.base import Measurement, Restricted
from ipe_bench.measurements.counted import cost
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise
from ipe_bench.noise.gaussian import Gaussian
from ipe_bench.real.residuals import Whiteness, explained, normalised, outlier_limit, whiteness
from ipe_bench.trials.fit_test import fit_probability, spread_of
from ipe_bench.trials.thresholds import FIT_LEVEL

_NORMAL = Gaussian(1.0)
"""Its whitened errors are those of any normal noise."""


@dataclass(frozen=True)
class Fit:
    """What one estimator makes of the readings."""

    label: str
    status: Status
    message: str
    x: Array
    """Estimates (n,) in physical units."""
    covariance: Array
    """(n, n) in physical units, as the estimator reports it; NaN where it reports none."""
    residuals: Array
    """z - h(x) (m,), in the unit of the readings; NaN where the reading is missing."""
    normalised: Array
    """Residuals (m,) in their own standard deviations; NaN where missing or where nothing can be said of them."""
    chi_square: float
    """Sum of squares of the whitened residuals."""
    degrees_of_freedom: int
    """Readings that are there, less parameters."""
    whiteness: Whiteness
    iterations: int
    p_value: float
    """Chance of a chi-square at least this large if the model and R are right: tiny means that they are not. Its law is
    that of the noise and of what the estimator leaves; see `ipe_bench.trials.fit_test`."""
    simulations: float
    """Evaluations of the model, a Jacobian counting n."""

    @property
    def standard_errors(self) -> Array:
        """(n,) in physical units; NaN where the estimator reports none."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.diagonal(self.covariance))

    @property
    def correlation(self) -> Array:
        """(n, n) of the parameters' errors."""
        with np.errstate(all="ignore"):
            correlation = self.covariance / np.outer(self.standard_errors, self.standard_errors)
        known = np.isfinite(self.standard_errors)
        correlation[known, known] = 1.0
        return correlation

    @property
    def residual_deviation(self) -> float:
        """Root of the residual sum of squares over the degrees of freedom, in the unit of the readings."""
        # A sum that skips NaN would be zero, and a perfect fit, where no residual is known.
        known = np.isfinite(self.residuals).any()
        return float(np.sqrt(np.nansum(self.residuals**2) / self.degrees_of_freedom)) if known else np.nan

    @property
    def fits(self) -> bool:
        return self.p_value >= FIT_LEVEL

    @property
    def outlier_limit(self) -> float:
        return outlier_limit(int(np.isfinite(self.residuals).sum()))

    @property
    def outliers(self) -> NDArray[np.bool_]:
        """The readings (m,) whose normalised residuals chance does not explain; see `ipe_bench.real.residuals`."""
        with np.errstate(invalid="ignore"):
            return np.abs(self.normalised) > self.outlier_limit


def fit(problem: Problem, z: Array, estimators: Mapping[str, Estimator], noise: Noise = _NORMAL) -> list[Fit]:
    """Lets every estimator loose on the readings z (m,), of which those that are NaN are missing; `noise` states the
    law of their whitened errors."""
    present = np.flatnonzero(~np.isnan(z))
    given = problem if len(present) == len(z) else _restricted(problem, present)
    order = _succession(problem.measurement, present)
    return [
        _fit_one(label, estimator, given, z[present], present, len(z), order, noise)
        for label, estimator in estimators.items()
    ]


def _restricted(problem: Problem, rows: Array) -> Problem:
    model = Restricted(problem.measurement, tuple(rows.tolist()))
    return Problem(model, problem.R.restricted(rows), problem.prior_deviation)


def _succession(model: Measurement, present: NDArray[np.intp]) -> NDArray[np.intp]:
    """Which of the present readings follow each other at one instrument: (channels, length), -1 where one is missing.

    The k-th readings of all epochs are one instrument's where every epoch has as many; otherwise, and without epochs,
    the readings are one succession in the order of the file.
    """
    place = np.full(model.m, -1, dtype=np.intp)
    place[present] = np.arange(len(present))
    epochs = model.epochs
    if epochs is None or len({len(rows) for rows in epochs}) != 1:
        return place[None]
    return place[np.stack([np.sort(rows) for rows in epochs]).T]


def _fit_one(
    label: str,
    estimator: Estimator,
    problem: Problem,
    z: Array,
    rows: NDArray[np.intp],
    m: int,
    order: NDArray[np.intp],
    noise: Noise,
) -> Fit:
    model, n = problem.measurement, problem.measurement.n
    estimates = estimate_safely(estimator, problem, z[None])
    message = estimates.messages.get(0, "")
    r, J = np.full(len(z), np.nan), np.full((len(z), n), np.nan)
    if np.isfinite(estimates.x).all():
        # Far from the truth a model may overflow or refuse: then nothing is known of the residuals.
        with np.errstate(all="ignore"):
            try:
                r = z - model.simulate(estimates.x)[0]
                J = model.jacobian(estimates.x)[0]
            except Exception as error:
                message = message or f"the residuals are unknown: {error}"
    w = problem.R.whiten(r)
    if np.isfinite(w).all() and np.isfinite(J).all():
        Q = explained(J, problem.R)
        scaled, white = normalised(w, Q, problem.R), whiteness(w, Q, order)
    else:
        scaled, white = np.full(len(z), np.nan), Whiteness(np.nan, 0, np.nan)
    chi_square = float(np.sum(w**2))
    spread = spread_of(estimator, problem, J[None])
    p = fit_probability(np.array([chi_square]), spread, noise, problem.H, problem.R)[0]
    P = np.full((n, n), np.nan) if estimates.covariance is None else estimates.covariance[0]
    return Fit(
        label,
        Status(int(estimates.status[0])),
        message,
        estimates.x[0] * model.sizes,
        P * np.outer(model.sizes, model.sizes),
        _at(rows, r, m),
        _at(rows, scaled, m),
        chi_square,
        len(z) - n,
        white,
        int(estimates.iterations[0]),
        float(p),
        float(cost(estimates.simulations, estimates.jacobians, n)[0]),
    )


def _at(rows: NDArray[np.intp], values: Array, m: int) -> Array:
    whole = np.full(m, np.nan)
    whole[rows] = values
    return whole
