"""Estimates from one set of real readings: values, standard errors, and whether the model fits them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri, ndtri, stdtr

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, Mask
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, estimate_safely
from ipe_bench.measurements.base import Measurement, SubsetModel
from ipe_bench.measurements.counted import cost
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise
from ipe_bench.noise.levels import Levels
from ipe_bench.noise.white import Gaussian
from ipe_bench.real.levels import Estimated, first_levels, levels_at, maximum, objective_of, unknown_levels
from ipe_bench.real.profiles import Released, half_width, wald_interval
from ipe_bench.real.residuals import Whiteness, explained, normalised, outlier_limit, whiteness
from ipe_bench.trials.fit_test import fit_probability, inflation_of, spread_of
from ipe_bench.trials.observability import in_words
from ipe_bench.trials.thresholds import FIT_LEVEL

_NORMAL = Gaussian(1.0)
"""Its whitened errors are those of any normal noise."""
_MOST_LEVELS = 6
"""Fits in search of the level of the noise."""
_SAME_LEVEL = 1e-3
"""The share by which the level changes at most where it is found."""
_SMALLEST_LEVEL = 1e-8
"""As a share of the readings, the level that estimators are told at least."""
_FARTHEST = 40.0
"""A normal deviate beyond every limit."""
_OPEN = 1e-4
"""A combination of parameters that changes the readings by less than this share of what others do may be open."""
Where = tuple[NDArray[np.intp], int, NDArray[np.intp]]
"""The present readings' rows, how many readings there are with the missing ones, and the succession of the present."""
_DOUBTED = 0.05
"""Where the test of the fit gives less, estimators that can look for a better fit: there is but one set of readings."""


@dataclass(frozen=True, kw_only=True)
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
    """Chance of a chi-square at least this large if the model and R are right (`ipe_bench.trials.fit_test`); NaN where
    that cannot be tested."""
    simulations: float
    """Evaluations of the model, a Jacobian counting n."""
    model: Measurement
    """What was fitted, without the readings that are missing."""
    inner: Array
    """The estimates (n,) as the estimator knows them: in multiples of sizes, or logarithms of distances to bounds."""
    inner_covariance: Array
    """Of those (n, n)."""
    assumed: Problem
    """What was fitted: the readings that are there, with R as it is known or estimated."""
    level: float | None = None
    """The estimated factor by which the readings are noisier than R says, which is in all other fields; None: R is
    known."""
    estimated: Estimated | None = None
    """The parameters with several levels of the noise, which x has behind them; then `level` is 1."""
    held: Fit | None = None
    """The fit of the model in which parameters are held on their bounds; those have no errors."""
    with_prior: bool = False
    """Whether the estimator was told a prior, so that x is not the least-squares estimate."""
    prior_inflation: float = 1.0
    """The factor by which the estimator widened the prior's standard deviations."""
    beaten_by: str = ""
    """The estimator with the least sum of squares, where it is so much smaller that chance does not explain it."""
    undetermined: tuple[str, ...] = ()
    """Combinations of parameters that the readings do not determine, such as 'd2 - d3'."""

    @property
    def held_at(self) -> dict[int, float]:
        """Which parameters are on a bound, because the readings want them beyond it, and the bound in their own
        unit."""
        on_bound = [] if self.held is None else np.flatnonzero(np.isnan(self.inner)).tolist()
        return {k: float(self.x[k]) for k in on_bound}

    @property
    def values(self) -> dict[str, float]:
        """The estimates in physical units, by the names of the parameters."""
        return dict(zip((p.name for p in self.model.physical_parameters), self.x.tolist(), strict=True))

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
        known = np.isfinite(self.residuals).any() and self.degrees_of_freedom > 0
        return float(np.sqrt(np.nansum(self.residuals**2) / self.degrees_of_freedom)) if known else np.nan

    @property
    def fits(self) -> bool | None:
        """Whether the residuals are as small as R says, or as small as they can be; None where neither can be told."""
        if self.beaten_by:
            return False
        # The size of the residuals says nothing of the model where it made R, nor without any degrees of freedom.
        return self.p_value >= FIT_LEVEL if self.level is None and self.degrees_of_freedom > 0 else None

    @property
    def passes(self) -> bool:
        """Whether this is an answer: the estimator converged, and nothing says that the model does not fit."""
        return self.status is Status.CONVERGED and self.fits is not False

    @property
    def _freedom(self) -> float | Array | None:
        """The degrees of freedom that the level of the noise is estimated from, or (n,) those behind the variance of
        each parameter; None where it is known."""
        if self.estimated is not None:
            return self.estimated.freedom
        return None if self.level is None else self.degrees_of_freedom

    @property
    def deviance(self) -> float:
        """What tells fits to the same readings apart: the sum of squares, whitened by R as it was stated; with several
        levels, twice the negative logarithm of the likelihood."""
        if self.estimated is not None:
            return self.estimated.deviance
        return self.chi_square * (1.0 if self.level is None else self.level**2)

    @property
    def levels(self) -> dict[str, float]:
        """Several levels of the noise by name."""
        names = [] if self.estimated is None else [p.name for p in self.estimated.model.noise.parameters]
        return dict(zip(names, self.x[len(self.x) - len(names) :].tolist(), strict=True))

    def interval(self, confidence: float = 0.95) -> tuple[Array, Array]:
        """Confidence intervals (n,), (n,) from the standard errors; inside of its bounds where a parameter has some."""
        with np.errstate(invalid="ignore"):
            deviation = np.sqrt(np.diagonal(self.inner_covariance))
        return wald_interval(self.model, self.inner, deviation, half_width(confidence, self._freedom))

    @property
    def outlier_limit(self) -> float:
        return outlier_limit(int(np.isfinite(self.residuals).sum()))

    @property
    def outliers(self) -> NDArray[np.bool_]:
        """The readings (m,) whose normalised residuals chance does not explain; see `ipe_bench.real.residuals`."""
        with np.errstate(invalid="ignore"):
            return np.abs(self.normalised) > self.outlier_limit


def fit(
    problem: Problem,
    z: Array,
    estimators: Mapping[str, Estimator],
    noise: Noise = _NORMAL,
) -> list[Fit]:
    """Has every estimator estimate from the readings z (m,), of which those that are NaN are missing.

    `noise` states the law of their whitened errors; or that R is known up to a factor, which is then estimated from the
    residuals of each fit.
    """
    present = np.flatnonzero(~np.isnan(z))
    given = replace(present_part(problem, present), doubted=1.0 if noise.estimated else _DOUBTED)
    where = present, len(z), _succession(problem.measurement, present)
    if (levels := noise.levels_of(problem.measurement)) is not None:
        levels, each = levels.restricted(present), estimators.items()
        found = [_fit_with_levels(label, one, given, z[present], where, levels) for label, one in each]
    elif noise.estimated:
        found = [_fit_with_level(label, one, given, z[present], where) for label, one in estimators.items()]
    else:
        found = [_fit_one(label, one, given, z[present], where, noise) for label, one in estimators.items()]
    return _compared(found)


def _compared(fits: list[Fit]) -> list[Fit]:
    """The fits, marked where they lie outside of the joint confidence region of the best (Bates and Watts, Nonlinear
    Regression Analysis and Its Applications, 1988, section 6.1)."""
    sums = [one.deviance for one in fits]
    known = [value if np.isfinite(value) else np.inf for value in sums]
    if not np.isfinite(known).any():
        return fits
    n, free, best = len(fits[0].x), fits[0].degrees_of_freedom, int(np.argmin(known))
    least = known[best]
    if fits[0].level is None or fits[0].estimated is not None:
        limit = least + float(chdtri(n, FIT_LEVEL))
    else:
        limit = least * (1 + n / free * float(fdtri(n, free, 1 - FIT_LEVEL))) if free > 0 else np.inf
    label = fits[best].label
    return [one if value <= limit else replace(one, beaten_by=label) for one, value in zip(fits, sums, strict=True)]


def _fit_with_level(label: str, estimator: Estimator, problem: Problem, z: Array, where: Where) -> Fit:
    """Fits until the level that R assumes is that of the residuals, since estimators measure their steps by it."""
    spread = float(np.sqrt(np.mean(problem.R.whiten(z) ** 2)))
    level, found = spread or 1.0, None
    for _ in range(_MOST_LEVELS):
        assumed = level
        again = _fit_one(label, estimator, scaled(problem, assumed), z, where, None)
        if found is not None and again.status is not Status.CONVERGED and found.status is Status.CONVERGED:
            break
        found = again
        free = found.degrees_of_freedom
        level = assumed * float(np.sqrt(found.chi_square / free)) if free > 0 else np.nan
        if level == 0.0:
            raise UserError(
                "noise: is not given and cannot be estimated from the residuals, which are zero; state it, as in"
                " noise.deviation=0.1"
            )
        found = _with_level(found, level / assumed, level)
        # Residuals of round-off would make steps of round-off count.
        level = max(level, _SMALLEST_LEVEL * spread)
        if not np.isfinite(level) or abs(level / assumed - 1.0) < _SAME_LEVEL:
            break
    assert found is not None
    return found


def scaled(problem: Problem, level: float) -> Problem:
    """The problem with readings that are noisier by a factor."""
    return replace(problem, R=Covariance(problem.R.factor * level))


def _with_level(found: Fit, factor: float, level: float) -> Fit:
    """The fit as it is with R multiplied by factor^2; residuals in their own deviations, which are then estimated."""
    with np.errstate(all="ignore"):
        return replace(
            found,
            covariance=found.covariance * factor**2,
            inner_covariance=found.inner_covariance * factor**2,
            chi_square=found.chi_square / factor**2,
            normalised=_deviates(found.normalised / factor, found.degrees_of_freedom),
            assumed=scaled(found.assumed, factor),
            level=level,
            held=None if found.held is None else _with_level(found.held, factor, level),
        )


def _deviates(r: Array, free: Array | int) -> Array:
    """The normal deviates (m,) that are as probable as residuals r (m,) in deviations that are estimated from `free`
    degrees of freedom.

    An internally studentised residual r becomes t = r sqrt((f - 1) / (f - r^2)), Student's t with f - 1 degrees of
    freedom (Cook and Weisberg, Residuals and Influence in Regression, 1982, eq. 2.2.8), and that the deviate.
    """
    with np.errstate(all="ignore"):
        t = r * np.sqrt((free - 1) / np.maximum(free - r**2, 0.0))
        deviates = np.where(np.asarray(free) > 1, -np.sign(r) * ndtri(stdtr(free - 1, -np.abs(t))), np.nan)
        # So improbable that it underflows: a deviate beyond every limit.
        return np.where(np.isinf(deviates), np.sign(r) * _FARTHEST, deviates)


def _fit_with_levels(label: str, estimator: Estimator, problem: Problem, z: Array, where: Where, levels: Levels) -> Fit:
    """Fits until the levels that R assumes are those of the residuals; where an estimator minimises the sum of squares,
    the maximum of the restricted likelihood near there."""
    theta, h = first_levels(levels, z), z
    found: tuple[Fit, Fit, Estimated] | None = None
    for _ in range(_MOST_LEVELS):
        R = levels.covariance(h, theta)
        again = _fit_one(label, estimator, replace(problem, R=R), z, where, None)
        if found is not None and again.status is not Status.CONVERGED:
            break
        h, inside = z - again.residuals[where[0]], again.held or again
        x, last = inside.inner, theta
        if not np.isfinite(h).all():
            return _at_levels(inside, estimator, unknown_levels(inside.assumed, levels, x), z, where)
        known = levels_at(inside.assumed, levels, theta, z, x)
        theta = known.x[len(x) :]
        found = again, inside, known
        if np.abs(theta - last).max() < _SAME_LEVEL:
            break
    assert found is not None
    again, inside, known = found
    if estimator.equation == "least_squares" and again.status is Status.CONVERGED:
        known = maximum(known, z)
    leveled = _at_levels(inside, estimator, known, z, where)
    if again.held is None:
        return leveled
    whole = replace(known.problem, measurement=replace(known.model, whole=again.assumed.measurement))
    x = np.concatenate([again.x, leveled.x[len(inside.x) :]])
    return _on_bounds(replace(leveled, x=x, model=whole.measurement, assumed=whole), leveled, again.held_at)


def _at_levels(found: Fit, estimator: Estimator, known: Estimated, z: Array, where: Where) -> Fit:
    """The fit with levels of the noise behind its parameters."""
    n, problem = len(found.x), replace(found.assumed, R=known.problem.R)
    x, P = known.x, known.P.copy()
    if not known.maximal:
        # Such an estimator takes the levels for known.
        P[:n, :n], P[:n, n:], P[n:, :n] = found.inner_covariance, 0.0, 0.0
    status = Status.STALLED if found.status is Status.CONVERGED and not known.converged else found.status
    estimates = Estimates(x[None, :n], np.array([status]), P[None, :n, :n])
    again = _described(found.label, estimator, problem, estimates, z, where, None)
    slope = known.model.physical_slope(x[None])[0]
    return replace(
        again,
        message=found.message,
        x=known.model.physical(x[None])[0],
        covariance=P * np.outer(slope, slope),
        normalised=at_rows(where[0], _deviates(again.normalised[where[0]], known.reading_freedom), where[1]),
        iterations=found.iterations,
        simulations=found.simulations,
        model=known.model,
        inner=x,
        inner_covariance=P,
        assumed=problem if found.with_prior else known.problem,
        level=1.0,
        estimated=known,
    )


def present_part(problem: Problem, rows: NDArray[np.intp]) -> Problem:
    """The problem of the readings that are there."""
    if len(rows) == problem.R.m:
        return problem
    model = SubsetModel(problem.measurement, tuple(rows.tolist()))
    return replace(problem, measurement=model, R=problem.R.restricted(rows))


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


def _fit_one(label: str, estimator: Estimator, problem: Problem, z: Array, where: Where, noise: Noise | None) -> Fit:
    """The fit within the bounds of the parameters, on some of them where its minimum lies there; see `_fit_inside`."""
    found = _fit_inside(label, estimator, problem, z, where, noise)
    near = {} if found.with_prior else problem.measurement.near_bounds(found.inner)
    if not 0 < len(near) < len(found.x):
        return found
    held = _fit_inside(label, estimator, holding(problem, near), z, where, noise)
    if held.status is not Status.CONVERGED or not falls_beyond(problem, held.inner[None], near, z[None])[0]:
        return found
    return _on_bounds(found, held, near)


def holding(problem: Problem, values: Mapping[int, float]) -> Problem:
    """The problem with some parameters fixed at values in their own units."""
    kept = [k for k in range(problem.measurement.n) if k not in values]
    deviation, correlation = problem.prior_deviation, problem.prior_correlation
    deviation = None if deviation is None else deviation[kept]
    correlation = None if correlation is None else correlation[np.ix_(kept, kept)]
    held = problem.measurement.fixed_at(values)
    return replace(problem, measurement=held, prior_deviation=deviation, prior_correlation=correlation)


def falls_beyond(
    problem: Problem, held: Array, near: Mapping[int, float], z: Array, released: Released | None = None
) -> Mask:
    """For which sets of readings z (sets, m) the sum of squares falls on beyond every bound, so that its minimum within
    them is on them, where it is `held` (sets, free) (Nocedal and Wright, Numerical Optimization, 2nd ed., 2006, theorem
    12.1)."""
    model, places = problem.measurement.unbounded(near), list(near)
    x = np.repeat(np.array(model.nominal, dtype=float)[None], len(z), axis=0)
    x[:, [k for k in range(model.n) if k not in near]] = held
    with np.errstate(all="ignore"):
        objective = objective_of(replace(problem, measurement=model), z)
        downhill = -np.einsum("tmi,tm->ti", objective.jacobian(x)[:, :, places], objective.residual(x))
    start = problem.measurement.physical(problem.measurement.nominal[None])[0]
    outward = np.sign(np.array(list(near.values())) - start[places])
    if released is not None:
        # These start on their bounds, and have been told which way leads inwards.
        inwards = dict(zip(released.places.tolist(), released.inwards.tolist(), strict=True))
        outward = np.array([-inwards.get(k, -out) for k, out in zip(places, outward, strict=True)])
    return np.asarray((downhill * outward > 0).all(axis=1))


def _on_bounds(found: Fit, held: Fit, near: Mapping[int, float]) -> Fit:
    """The fit with some parameters on their bounds, those having no errors."""
    n = len(found.x)
    free = np.array([k for k in range(n) if k not in near])
    x, inner, P, inner_P = np.empty(n), np.full(n, np.nan), np.full((n, n), np.nan), np.full((n, n), np.nan)
    x[list(near)], x[free], inner[free] = list(near.values()), held.x, held.inner
    P[np.ix_(free, free)], inner_P[np.ix_(free, free)] = held.covariance, held.inner_covariance
    of_whole = {"model": found.model, "assumed": found.assumed}
    return replace(held, x=x, inner=inner, covariance=P, inner_covariance=inner_P, held=held, **of_whole)


def _fit_inside(label: str, estimator: Estimator, problem: Problem, z: Array, where: Where, noise: Noise | None) -> Fit:
    """The fit to readings z, which stand `where` among all. `noise` None: its level is not known, and the size of the
    residuals cannot be tested."""
    estimates = estimate_safely(estimator, problem, z[None])
    return _described(label, estimator, problem, estimates, z, where, noise)


def _described(
    label: str,
    estimator: Estimator,
    problem: Problem,
    estimates: Estimates,
    z: Array,
    where: Where,
    noise: Noise | None,
) -> Fit:
    """Estimates, with what their residuals say."""
    (rows, m, order), model, n = where, problem.measurement, problem.measurement.n
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
    w, p = problem.R.whiten(r), np.nan
    open_ones, deviates, white = (), np.full(len(z), np.nan), Whiteness(np.nan, 0, np.nan)
    if np.isfinite(w).all() and np.isfinite(J).all():
        Q = explained(J, problem.R)
        deviates, white = normalised(w, Q, problem.R), whiteness(w, Q, order)
        if "prior" not in estimator.needs:
            open_ones = undetermined(model, problem.R.whiten_jacobian(J), estimates.x[0])
    chi_square = float(np.sum(w**2))
    if noise is not None:
        spread = spread_of(estimator, problem, J[None])
        p = fit_probability(np.array([chi_square]), spread, noise, problem.H, problem.R)[0]
    P = np.full((n, n), np.nan) if estimates.covariance is None else estimates.covariance[0]
    slope = model.physical_slope(estimates.x)[0]
    return Fit(
        label=label,
        status=Status(int(estimates.status[0])),
        message=message,
        x=model.physical(estimates.x)[0],
        covariance=P * np.outer(slope, slope),
        residuals=at_rows(rows, r, m),
        normalised=at_rows(rows, deviates, m),
        chi_square=chi_square,
        degrees_of_freedom=len(z) - n,
        whiteness=white,
        iterations=int(estimates.iterations[0]),
        p_value=float(p),
        simulations=float(cost(estimates.simulations, estimates.jacobians, n)[0]),
        model=model,
        inner=estimates.x[0],
        inner_covariance=P,
        assumed=problem,
        with_prior="prior" in estimator.needs,
        prior_inflation=inflation_of(estimator),
        undetermined=open_ones,
    )


def undetermined(model: Measurement, J: Array, x: Array) -> tuple[str, ...]:
    """The combinations of parameters that whitened readings of slopes J (m, n) do not determine at x (n,): they hardly
    change the readings, and errors of the parameters along them are larger than the parameters."""
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1.0)
    missing = max(len(x) - len(J), 0)
    _, s, right = np.linalg.svd(np.pad(J / size, ((0, missing), (0, 0))), full_matrices=False)
    found = []
    for value, direction in zip(s, right / size, strict=True):
        error = np.abs(direction) / max(value, np.finfo(float).eps * s[0])
        along = direction * model.physical_slope(x[None])[0]
        # Of a parameter that is as good as on a bound x says nothing.
        if value < _OPEN * s[0] and along.any() and (error > np.maximum(np.abs(x), 1.0)).any():
            found.append(in_words([p.name for p in model.physical_parameters], along))
    return tuple(found)


def at_rows(rows: NDArray[np.intp], values: Array, m: int) -> Array:
    """Values of some of m readings; NaN of the others."""
    whole = np.full(m, np.nan)
    whole[rows] = values
    return whole
