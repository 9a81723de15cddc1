"""Finds the minimum that is worth an examination, of those that estimators have found."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.examination import BOOTSTRAPS, LOWER, Examination
from ipe_bench.real.fits import FAR_BELOW, Fit, constrained, holding, scaled
from ipe_bench.real.levels import maximise_likelihood, maximum
from ipe_bench.real.on_bounds import on_bounds, released_at


def examine(
    problem: Problem, z: Array, fits: list[Fit], *, bootstraps: int = BOOTSTRAPS
) -> Examination | None:
    """Examines the least of the minima that estimators without a prior found, of several that found
    it the first that passes; None if none of them found one."""
    best = _best(fits)
    if best is None or best.exact:
        return None
    held_at = best.held_at
    if held_at:
        problem = holding(constrained(problem), held_at)
    rows = np.flatnonzero(np.isfinite(z))
    least = _least_levelled(best, z[rows]) if best.estimated is not None else _least(best, z[rows])
    if not least.converged or not (np.diag(least.P) > 0).all():
        return None
    found = Examination(
        label=best.label,
        whole=problem,
        rows=rows,
        problem=least.assumed,
        z=z[rows],
        inner=least.inner,
        P=least.P,
        chi_square=least.chi_square,
        freedom=least.freedom,
        bootstraps=bootstraps,
        overstated=best.overstated >= FAR_BELOW,
    )
    # The place of a step has no profile.
    if not held_at or best.between:
        return found
    outer = Problem(best.model, best.assumed.R)
    return replace(
        found,
        released=released_at(outer, found, held_at),
        on_bounds=tuple(on_bounds(outer, found, held_at)),
    )


def _best(fits: list[Fit]) -> Fit | None:
    """Finds the fit at the least minimum; of several there the first of least squares that
    passes."""
    told = [
        one
        for one in fits
        if one.status is Status.CONVERGED and np.isfinite(one.chi_square) and not one.with_prior
    ]
    best = min(told, key=lambda one: one.deviance, default=None)
    if best is None:
        return None
    near = best.deviance + LOWER * max(1.0, abs(best.deviance))
    passing = (one for one in told if one.passes and one.deviance <= near and _least_squares(one))
    return next(passing, best)


class _Least(NamedTuple):
    """Holds the minimum near a fit."""

    assumed: Problem
    inner: Array
    P: Array
    chi_square: float
    freedom: int | Array | None
    converged: bool


def _least_levelled(best: Fit, z: Array) -> _Least:
    """Finds the maximum of the restricted likelihood of readings z (m,) near a fit with several
    levels."""
    assert best.estimated is not None
    found = maximum(best.estimated, z)
    residual = z - found.model.near(found.fitted, z)
    chi_square = float(np.sum(found.problem.R.whiten(residual) ** 2))
    return _Least(found.problem, found.x, found.P, chi_square, found.freedom, found.converged)


def _least(best: Fit, z: Array) -> _Least:
    """Finds the least sum of squares of readings z (m,) near a fit."""
    minima = maximise_likelihood(best.assumed, z[None], best.inner[None])
    inner = minima.x[0]
    P = minima.covariance[0]
    chi_square = float(minima.chi_square[0])
    converged = bool(minima.converged[0])
    if best.level is None:
        return _Least(best.assumed, inner, P, chi_square, None, converged)
    # The minimum's own level, where the estimator's was a little higher.
    freedom = best.degrees_of_freedom
    factor = float(np.sqrt(chi_square / freedom))
    assumed = scaled(best.assumed, factor)
    return _Least(assumed, inner, P * factor**2, chi_square / factor**2, freedom, converged)


def _least_squares(one: Fit) -> bool:
    return one.estimator.equation == "least_squares"
