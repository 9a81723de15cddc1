"""Looks for further estimates: at a lower minimum that the examination finds, and at the values of
columns for parameters at which readings step or bend."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar, NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, repeated
from ipe_bench.estimators.base import Equation, Estimates, Estimator
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import minimize
from ipe_bench.measurements.base import Measurement, WrappedModel
from ipe_bench.measurements.known import ConstrainedModel
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise
from ipe_bench.real.examination import Examination
from ipe_bench.real.examined import examine
from ipe_bench.real.fits import Fit, compared, constrained, fit, holding

LABEL = "search"
_AT_ONCE = 48
"""Values of a column that are tried together."""
_FAR_APART = 12
"""Values of a column that are tried for each of two parameters."""
_SAME = 1e-9
"""Share by which sums of squares of the same fit differ at most."""
_ROUNDS = 12
"""Times at most that a parameter is placed among the values of a column."""
_MOST = 3
"""Lower minima that are taken one after another at most."""


@dataclass(frozen=True)
class From(Estimator):
    """Minimises least squares from a point by Levenberg-Marquardt steps."""

    point: Mapping[str, float]
    """Parameters in the coordinates of the model, by their names there."""

    equation: ClassVar[Equation | None] = "least_squares"

    def __post_init__(self) -> None:
        """Skips the checks of options: the point was found."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        names = [p.name for p in problem.measurement.parameters]
        start = np.array([self.point[name] for name in names])
        objective = Objective.of(problem, z)
        limits = Limits(1e-6, 100, None, history)
        x = repeated(start, len(z))
        minima = minimize(objective, LevenbergMarquardtMethod(1e-3), x, limits)
        return minima.estimates(objective.model.tally, z.shape[1])


def examined(
    problem: Problem, z: Array, fits: list[Fit], noise: Noise
) -> tuple[list[Fit], Examination | None]:
    """Examines the least minimum of the fits to readings z (m,); if that finds a lower one, by more
    than chance explains, the fit there is one of the fits, and is examined."""
    fits = _with_steps(problem, z, fits, noise)
    found = examine(problem, z, fits)
    for _ in range(_MOST):
        # What is held on a bound has no start inside.
        if found is None or found.least or found.on_bounds:
            break
        further = _fit_from(problem, z, noise, found.model, found.minima[0].inner)
        before = [replace(one, beaten_by="", lower_at="") for one in fits if one.label != LABEL]
        fits = compared([*before, further])
        found = examine(problem, z, fits)
    return fits, found


def _fit_from(problem: Problem, z: Array, noise: Noise, model: Measurement, x: Array) -> Fit:
    """Fits from a point x (n,) in the coordinates of a model."""
    names = [p.name for p in model.parameters]
    point = dict(zip(names, x.tolist(), strict=True))
    (found,) = fit(problem, z, {LABEL: From(point)}, noise)
    return found


def _with_steps(problem: Problem, z: Array, fits: list[Fit], noise: Noise) -> list[Fit]:
    """Adds a fit, if none passes, in which a parameter that moves no reading has the best of the
    values between those of the columns, as the place of a step has."""
    told = [one for one in fits if np.isfinite(one.deviance) and not one.with_prior]
    best = min(told, key=lambda one: one.deviance, default=None)
    if best is None or best.held_at or best.estimated is not None:
        return fits
    if any(one.passes for one in fits):
        return fits
    moved, between = _among_columns(best)
    if not between:
        return fits
    further = _fit_from(problem, z, noise, best.model, moved.inner)
    steps = {place: between[place] for place in further.idle if place in between}
    if len(steps) < len(further.idle):
        return fits
    if steps:
        if not all(_same_between(further, place, *ends) for place, ends in steps.items()):
            return fits
        # The readings step there, and no slope tells where.
        middles = {place: (low + high) / 2 for place, (low, high) in steps.items()}
        rest = holding(constrained(problem), middles)
        held = _fit_from(rest, z, noise, best.model, moved.inner)
        further = replace(held, model=further.model, held_at=middles, between=steps)
    before = [replace(one, beaten_by="", lower_at="") for one in fits]
    return compared([*before, further])


def _among_columns(best: Fit) -> tuple[Fit, dict[int, tuple[float, float]]]:
    """Moves parameters that move no reading among the values of the columns, one after another and
    again, while the sum of squares falls; returns the fit there, and the values between which each
    lies."""
    between: dict[int, tuple[float, float]] = {}
    for _ in range(_ROUNDS):
        ends = [end for place in best.idle for end in _along_columns(best, place)]
        ends = ends or [end for pair in combinations(between, 2) for end in _in_pairs(best, *pair)]
        if not ends:
            break
        least = min(ends, key=lambda one: one.squares)
        between |= least.between
        x = least.x
        with np.errstate(all="ignore"):
            h = best.assumed.measurement.simulate(x[None])[0]
        residual = best.given.z - best.assumed.measurement.near(h, best.given.z)
        best = replace(best, inner=x, residual=residual)
    return best, between


class _End(NamedTuple):
    """Holds the least sum of squares with parameters between two values of a column each."""

    squares: float
    x: Array
    between: dict[int, tuple[float, float]]


def _along_columns(best: Fit, place: int) -> list[_End]:
    """Finds the sums of squares that are less than that of the fit, each less than the one before,
    with one parameter between two values of a column."""
    least = best.chi_square * (1 - _SAME)
    found = []
    for column in _columns(best.model):
        low = 0
        high = len(column) - 1
        # The gap of the column that is best among few, then among those next to it.
        while high > low:
            gaps = np.unique(np.linspace(low, high - 1, _AT_ONCE).astype(int))
            middles = (column[gaps] + column[gaps + 1]) / 2
            x, squares = _least_with(best, (place,), middles[:, None])
            k = int(np.argmin(squares))
            if squares[k] < least:
                least = squares[k]
                between = {place: (float(column[gaps[k]]), float(column[gaps[k] + 1]))}
                found.append(_End(float(squares[k]), x[k], between))
            if len(gaps) == high - low:
                break
            low = gaps[max(k - 1, 0)]
            high = gaps[min(k + 1, len(gaps) - 1)] + 1
    return found


def _in_pairs(best: Fit, first: int, second: int) -> Iterator[_End]:
    """Finds a sum of squares that is less than that of the fit with two parameters between values
    of a column that are far apart: one alone may not lead there."""
    for column in _columns(best.model):
        gaps = np.unique(np.linspace(0, len(column) - 2, _FAR_APART).astype(int))
        one, other = np.meshgrid(gaps, gaps)
        pairs = np.stack([one.ravel(), other.ravel()], axis=1)
        x, squares = _least_with(best, (first, second), (column[pairs] + column[pairs + 1]) / 2)
        k = int(np.argmin(squares))
        if squares[k] < best.chi_square * (1 - _SAME):
            ends = zip(column[pairs[k]].tolist(), column[pairs[k] + 1].tolist(), strict=True)
            yield _End(float(squares[k]), x[k], dict(zip((first, second), ends, strict=True)))


def _columns(model: Measurement) -> Iterator[Array]:
    """Yields the different values of each column of numbers, in their order."""
    for name, column in model.index.items():
        values = np.unique(np.asarray(column))
        if name != "row" and np.issubdtype(values.dtype, np.number) and len(values) > 1:
            yield values.astype(float)


def _least_with(best: Fit, places: tuple[int, ...], values: Array) -> tuple[Array, Array]:
    """Minimises the sum of squares from the fit with some parameters at values (sets, places), and
    returns where that led to (sets, n), with the sums (sets,), infinite where there is none."""
    problem = best.assumed
    x = _placed(best, places, values)
    with np.errstate(all="ignore"):
        objective = Objective.of(problem, repeated(best.given.z, len(values)))
        limits = Limits(1e-6, 100)
        ended = minimize(objective, LevenbergMarquardtMethod(1e-3), x, limits)
        squares = np.sum(objective.residual(ended.x) ** 2, axis=1)
    return ended.x, np.where(np.isfinite(x).all(axis=1) & np.isfinite(squares), squares, np.inf)


def _placed(best: Fit, places: tuple[int, ...], values: Array) -> Array:
    """Returns the fit's parameters (sets, n) with some of them at values (sets, places); not finite
    outside of its bounds."""
    model = best.assumed.measurement
    whole = model
    while isinstance(whole, WrappedModel) and not isinstance(whole, ConstrainedModel):
        whole = whole.whole
    own = model.physical(repeated(best.inner, len(values)))
    own[:, places] = values
    with np.errstate(all="ignore"):
        moved = whole.inner(own) if isinstance(whole, ConstrainedModel) else own / model.sizes
    x = repeated(best.inner, len(values))
    x[:, places] = moved[:, places]
    return x


def _same_between(further: Fit, place: int, low: float, high: float) -> bool:
    """Tells whether readings are the same with one parameter anywhere between two values."""
    among = low + (high - low) * np.linspace(0.001, 0.999, 5)
    x = _placed(further, (place,), among[:, None])
    with np.errstate(all="ignore"):
        h = further.assumed.measurement.simulate(x)
    return bool((h == h[0]).all())
