"""Fits one set of real readings: values, standard errors, and whether the model fits them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, Mask
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimator, estimate_safely
from ipe_bench.measurements.base import Measurement, SubsetModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.noise.base import Noise
from ipe_bench.noise.levels import Levels
from ipe_bench.real.levels import Estimated, first_levels, levels_at, maximum, objective_of
from ipe_bench.real.profiles import Released, half_width, joint_region, wald_interval
from ipe_bench.real.residuals import explained, normalised, outlier_limit, whiteness
from ipe_bench.trials.fit_test import fit_probability, spread_of
from ipe_bench.trials.observability import in_words
from ipe_bench.trials.thresholds import FIT_LEVEL

_NORMAL = Gaussian(1.0)
"""Noise whose whitened errors are those of any normal one."""
_MOST_LEVELS = 6
"""Fits in search of the level of the noise."""
_SAME_LEVEL = 1e-3
"""The most by which the level changes, as a share, once it is found."""
_SMALLEST_LEVEL = 1e-8
"""The least level that estimators are given, as a share of the readings: steps of round-off must not count."""
_FARTHEST = 40.0
"""Stands for an infinite normal deviate."""
_OPEN = 1e-4
"""A combination of parameters that changes the readings by less than this share of what others do may be open."""
_DOUBTED = 0.05
"""Least p of the test of the fit without a search for a better one, since there is but one set of readings."""


@dataclass(frozen=True)
class Given:
    """Holds the readings z (present,) at `rows` of those of a model, and their problem."""

    problem: Problem
    model: Measurement
    """The model of all readings, with those that are missing."""
    rows: NDArray[np.intp]
    z: Array
    noise: Noise

    @cached_property
    def series(self) -> NDArray[np.intp]:
        """The readings of each instrument in their order (channels, length), -1 if one is missing: the k-th of all
        epochs, if every epoch has as many; otherwise all in the order of the file."""
        place = np.full(self.model.m, -1, dtype=np.intp)
        place[self.rows] = np.arange(len(self.rows))
        epochs = self.model.epochs
        if epochs is None or len({len(rows) for rows in epochs}) != 1:
            return place[None]
        return place[np.stack([np.sort(rows) for rows in epochs]).T]


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Holds the fit of one estimator to the readings."""

    label: str
    estimator: Estimator
    given: Given
    status: Status
    message: str
    model: Measurement
    """The model of the readings that are present, with the levels of the noise that are estimated."""
    assumed: Problem
    """The problem that was solved: R is known or estimated, and parameters on their bounds are held there."""
    inner: Array
    """Estimates (n,) of those that are not held, as multiples of sizes or logarithms of distances to bounds."""
    inner_covariance: Array
    """Their covariance (n, n), as the estimator reports it; NaN if it reports none."""
    residual: Array
    """z - h(x) of the readings that are present; NaN if it cannot be computed."""
    iterations: int
    simulations: float
    """Evaluations of the model, a Jacobian counting n."""
    held_at: Mapping[int, float] = field(default_factory=dict)
    """The parameters that are on a bound, because the readings want them beyond it, and the bound in their own unit."""
    level: float | None = None
    """The factor by which the readings are noisier than was stated, if it is estimated."""
    estimated: Estimated | None = None
    """The parameters with several levels of the noise, which stand behind them; then `level` is 1."""
    beaten_by: str = ""
    """The estimator with the least sum of squares, if that is so much smaller that chance does not explain it."""

    def _all(self, free: Array) -> Array:
        """Returns values (n,) or (n, n) of all parameters, NaN for those that are held on bounds."""
        n = len(free) + len(self.held_at)
        kept, found = [k for k in range(n) if k not in self.held_at], np.full((n,) * free.ndim, np.nan)
        found[np.ix_(*[kept] * free.ndim)] = free
        return found

    @property
    def _free(self) -> Measurement:
        """The model of the parameters that are not held."""
        return self.assumed.measurement if self.estimated is None else self.estimated.model

    @cached_property
    def x(self) -> Array:
        """Estimates (n,) in physical units."""
        x = self._all(self._free.physical(self.inner[None])[0])
        x[list(self.held_at)] = list(self.held_at.values())
        return x

    @cached_property
    def covariance(self) -> Array:
        """(n, n) in physical units, as the estimator reports it; NaN if it reports none."""
        slope = self._free.physical_slope(self.inner[None])[0]
        return self._all(self.inner_covariance * np.outer(slope, slope))

    @property
    def values(self) -> dict[str, float]:
        """The estimates in physical units, by the names of the parameters."""
        return dict(zip((p.name for p in self.model.physical_parameters), self.x.tolist(), strict=True))

    @property
    def standard_errors(self) -> Array:
        """(n,) in physical units; NaN if the estimator reports none."""
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
    def with_prior(self) -> bool:
        return "prior" in self.estimator.needs

    @property
    def residuals(self) -> Array:
        """z - h(x) (m,), in the unit of the readings; NaN if the reading is missing."""
        return at_rows(self.given.rows, self.residual, self.given.model.m)

    @property
    def degrees_of_freedom(self) -> int:
        """Readings that are present, less parameters."""
        return len(self.residual) - self.assumed.measurement.n

    @cached_property
    def chi_square(self) -> float:
        """Sum of squares of the whitened residuals."""
        return float(np.sum(self._whitened**2))

    @property
    def _whitened(self) -> Array:
        return self.assumed.R.whiten(self.residual)

    @cached_property
    def _J(self) -> Array:
        """dh/dx (m, n) of the readings that are present; NaN if it cannot be computed."""
        model = self.assumed.measurement
        if not np.isfinite(self.residual).all():
            return np.full((len(self.residual), model.n), np.nan)
        with np.errstate(all="ignore"):
            return model.jacobian(self.inner[None, : model.n])[0]

    @cached_property
    def _explained(self) -> Array | None:
        """A basis of what the parameters explain of the whitened readings; None if it is not known."""
        known = np.isfinite(self._whitened).all() and np.isfinite(self._J).all()
        return explained(self._J, self.assumed.R) if known else None

    @cached_property
    def normalised(self) -> Array:
        """Residuals (m,) in their own standard deviations; NaN if missing or if nothing can be said of them."""
        values = np.full(len(self.residual), np.nan)
        if self._explained is not None:
            values = normalised(self._whitened, self._explained, self.assumed.R)
            if self.estimated is not None:
                values = _deviates(values, self.estimated.reading_freedom)
            elif self.level is not None:
                values = _deviates(values, self.degrees_of_freedom)
        return at_rows(self.given.rows, values, self.given.model.m)

    @cached_property
    def white_p(self) -> float:
        """The p of the test that successive residuals do not resemble each other; NaN if that cannot be tested."""
        if self._explained is None:
            return np.nan
        return whiteness(self._whitened, self._explained, self.given.series)

    @cached_property
    def undetermined(self) -> tuple[str, ...]:
        """Combinations of parameters that the readings do not determine, such as 'd2 - d3'."""
        if self._explained is None or self.with_prior:
            return ()
        model = self.assumed.measurement
        return undetermined(model, self.assumed.R.whiten_jacobian(self._J), self.inner[: model.n])

    @cached_property
    def p_value(self) -> float:
        """Chance of a larger chi-square if the model and R are right (`ipe_bench.trials.fit_test`); NaN if unknown."""
        if self.level is not None:
            return np.nan
        spread = spread_of(self.estimator, self.assumed, self._J[None])
        squares, problem = np.array([self.chi_square]), self.assumed
        return float(fit_probability(squares, spread, self.given.noise, problem.H, problem.R)[0])

    @property
    def residual_deviation(self) -> float:
        """Root of the residual sum of squares over the degrees of freedom, in the unit of the readings."""
        free = self.degrees_of_freedom
        return float(np.sqrt(np.sum(self.residual**2) / free)) if free > 0 else np.nan

    @property
    def fits(self) -> bool | None:
        """Tells whether residuals are as small as R says, or as small as they can be; None if neither can be told."""
        if self.beaten_by or (np.isfinite(self.x).all() and not np.isfinite(self.residual).all()):
            return False
        # The size of the residuals says nothing of the model where it made R, nor without any degrees of freedom.
        return self.p_value >= FIT_LEVEL if self.level is None and self.degrees_of_freedom > 0 else None

    @property
    def passes(self) -> bool:
        """Tells whether the estimator converged, and nothing says that the model does not fit."""
        return self.status is Status.CONVERGED and self.fits is not False

    @property
    def deviance(self) -> float:
        """The sum of squares, whitened by R as it was stated; with several levels, -2 times the log likelihood."""
        if self.estimated is not None:
            return self.estimated.deviance
        return self.chi_square * (1.0 if self.level is None else self.level**2)

    @property
    def levels(self) -> dict[str, float]:
        """Several levels of the noise by name."""
        names = [] if self.estimated is None else [p.name for p in self.estimated.model.noise.parameters]
        return dict(zip(names, self.x[len(self.x) - len(names) :].tolist(), strict=True))

    def interval(self, confidence: float = 0.95) -> tuple[Array, Array]:
        """Computes confidence intervals (n,), (n,) from the standard errors, inside of bounds; NaN for levels of the
        noise: only profiles hold them as often as they say."""
        freedom = None if self.level is None else self.degrees_of_freedom
        if self.estimated is not None:
            freedom = self.estimated.freedom
        with np.errstate(invalid="ignore"):
            deviation = np.sqrt(np.diagonal(self.inner_covariance))
        low, high = wald_interval(self._free, self.inner, deviation, half_width(confidence, freedom))
        low, high = self._all(low), self._all(high)
        for ends in (low, high):
            ends[len(ends) - len(self.levels) :] = np.nan
        return low, high

    @property
    def outlier_limit(self) -> float:
        return outlier_limit(int(np.isfinite(self.residual).sum()))

    @property
    def outliers(self) -> Mask:
        """The readings (m,) whose normalised residuals chance does not explain; see `ipe_bench.real.residuals`."""
        with np.errstate(invalid="ignore"):
            return np.abs(self.normalised) > self.outlier_limit


def fit(problem: Problem, z: Array, estimators: Mapping[str, Estimator], noise: Noise = _NORMAL) -> list[Fit]:
    """Fits every estimator to the readings z (m,), NaN if missing; `noise` is the law of their whitened errors, or says
    that R is known up to levels, which are then estimated."""
    rows, present = np.flatnonzero(~np.isnan(z)), replace(problem, doubted=1.0 if noise.estimated else _DOUBTED)
    if len(rows) < len(z):
        model = SubsetModel(problem.measurement, tuple(rows.tolist()))
        present = replace(present, measurement=model, R=problem.R.restricted(rows))
    given = Given(present, problem.measurement, rows, z[rows], noise)
    if (levels := noise.levels_of(problem.measurement)) is not None:
        levels = levels.restricted(rows)
        return _compared([_fit_reml(given, *one, levels) for one in estimators.items()])
    fitted = _fit_scaled if noise.estimated else _fit_one
    return _compared([fitted(given, *one, present) for one in estimators.items()])


def _compared(fits: list[Fit]) -> list[Fit]:
    """Marks fits that lie outside of the joint confidence region of the best (Bates and Watts, Nonlinear Regression
    Analysis and Its Applications, 1988, section 6.1)."""
    sums = [one.deviance if np.isfinite(one.deviance) else np.inf for one in fits]
    best = int(np.argmin(sums))
    least, n, free = sums[best], len(fits[0].x), fits[0].degrees_of_freedom
    if np.isinf(least):
        return fits
    if fits[0].level is None or fits[0].estimated is not None:
        limit = least + joint_region(n, 1 - FIT_LEVEL, None)
    else:
        limit = least + least / free * joint_region(n, 1 - FIT_LEVEL, free) if free > 0 else np.inf
    label = fits[best].label
    return [replace(one, beaten_by=label) if one.deviance > limit else one for one in fits]


def _fit_scaled(given: Given, label: str, estimator: Estimator, problem: Problem) -> Fit:
    """Iterates the fit until the level that R assumes is that of the residuals."""
    spread = float(np.sqrt(np.mean(problem.R.whiten(given.z) ** 2)))
    level, found = spread or 1.0, None
    for _ in range(_MOST_LEVELS):
        assumed = level
        again = _fit_one(given, label, estimator, scaled(problem, assumed))
        if found is not None and again.status is not Status.CONVERGED and found.status is Status.CONVERGED:
            break
        free = again.degrees_of_freedom
        level = assumed * float(np.sqrt(again.chi_square / free)) if free > 0 else np.nan
        if level == 0.0:
            raise UserError(
                "noise: is not given and cannot be estimated from the residuals, which are zero; state it, as in"
                " noise.deviation=0.1"
            )
        factor = level / assumed
        P, R = again.inner_covariance * factor**2, scaled(again.assumed, factor)
        found = replace(again, inner_covariance=P, assumed=R, level=level)
        level = max(level, _SMALLEST_LEVEL * spread)
        if not np.isfinite(level) or abs(level / assumed - 1.0) < _SAME_LEVEL:
            break
    assert found is not None
    return found


def scaled(problem: Problem, level: float) -> Problem:
    """Returns the problem with readings that are noisier by a factor."""
    return replace(problem, R=Covariance(problem.R.factor * level))


def _deviates(r: Array, free: Array | int) -> Array:
    """Computes the normal deviates (m,) that are as probable as internally studentised residuals r (m,) of f = `free`
    degrees of freedom, by r sqrt((f - 1) / (f - r^2)), which is Student's t with f - 1 (Cook and Weisberg, Residuals
    and Influence in Regression, 1982, eq. 2.2.8)."""
    with np.errstate(all="ignore"):
        t = r * np.sqrt((free - 1) / np.maximum(free - r**2, 0.0))
        deviates = np.where(np.asarray(free) > 1, -np.sign(r) * ndtri(stdtr(free - 1, -np.abs(t))), np.nan)
        # So improbable that it underflows: a deviate beyond every limit.
        return np.where(np.isinf(deviates), np.sign(r) * _FARTHEST, deviates)


def _fit_reml(given: Given, label: str, estimator: Estimator, levels: Levels) -> Fit:
    """Iterates the fit until the levels that R assumes are those of the residuals; of least squares, to the maximum of
    the restricted likelihood near there."""
    theta, h, z = first_levels(levels, given.z), given.z, given.z
    found: tuple[Fit, Estimated] | None = None
    for _ in range(_MOST_LEVELS):
        again = _fit_one(given, label, estimator, replace(given.problem, R=levels.covariance(h, theta)))
        if found is not None and again.status is not Status.CONVERGED:
            break
        found = again, levels_at(again.assumed, levels, theta, z, again.inner)
        h, last, theta = z - again.residual, theta, found[1].x[len(again.inner) :]
        if not np.abs(theta - last).max() >= _SAME_LEVEL:
            break
    assert found is not None
    again, known = found
    converged = again.status is Status.CONVERGED
    if estimator.equation == "least_squares" and converged:
        known = maximum(known, z)
    n, P = len(again.inner), known.P.copy()
    if not known.maximal:
        # Such an estimator takes the levels for known.
        P[:n, :n], P[:n, n:], P[n:, :n] = again.inner_covariance, 0.0, 0.0
    return replace(
        again,
        status=Status.STALLED if converged and not known.converged else again.status,
        model=replace(known.model, whole=again.model),
        assumed=replace(again.assumed, R=known.problem.R),
        inner=known.x,
        inner_covariance=P,
        residual=z - known.model.near(known.fitted, z),
        level=1.0,
        estimated=known,
    )


def _fit_one(given: Given, label: str, estimator: Estimator, problem: Problem) -> Fit:
    """Fits within the bounds of the parameters, on some of them if the minimum is there."""
    found = _fit_inside(given, label, estimator, problem)
    near = {} if found.with_prior else problem.measurement.near_bounds(found.inner)
    if not 0 < len(near) < len(found.inner):
        return found
    held = _fit_inside(given, label, estimator, holding(problem, near))
    if held.status is not Status.CONVERGED or not falls_beyond(problem, held.inner[None], near, given.z[None])[0]:
        return found
    return replace(held, model=found.model, held_at=near)


def holding(problem: Problem, values: Mapping[int, float]) -> Problem:
    """Returns the problem with some parameters fixed at values in their own units."""
    kept = [k for k in range(problem.measurement.n) if k not in values]
    deviation, correlation = problem.prior_deviation, problem.prior_correlation
    deviation = None if deviation is None else deviation[kept]
    correlation = None if correlation is None else correlation[np.ix_(kept, kept)]
    held = problem.measurement.stating("fixed", values)
    return replace(problem, measurement=held, prior_deviation=deviation, prior_correlation=correlation)


def falls_beyond(
    problem: Problem, held: Array, near: Mapping[int, float], z: Array, released: Released | None = None
) -> Mask:
    """Finds the sets of readings z (sets, m) whose sum of squares at `held` (sets, free) falls beyond every bound
    (Nocedal and Wright, Numerical Optimization, 2nd ed., 2006, theorem 12.1)."""
    model, places = problem.measurement.stating("nominal", near), list(near)
    x = np.repeat(np.array(model.nominal, dtype=float)[None], len(z), axis=0)
    x[:, [k for k in range(model.n) if k not in near]] = held
    with np.errstate(all="ignore"):
        objective = objective_of(replace(problem, measurement=model), z)
        downhill = -np.einsum("tmi,tm->ti", objective.jacobian(x)[:, :, places], objective.residual(x))
    start = problem.measurement.physical(problem.measurement.nominal[None])[0]
    outward = np.sign(np.array(list(near.values())) - start[places])
    if released is not None:
        inwards = dict(zip(released.places.tolist(), released.inwards.tolist(), strict=True))
        outward = np.array([-inwards.get(k, -out) for k, out in zip(places, outward, strict=True)])
    return np.asarray((downhill * outward > 0).all(axis=1))


def _fit_inside(given: Given, label: str, estimator: Estimator, problem: Problem) -> Fit:
    estimates, model, n = estimate_safely(estimator, problem, given.z[None]), problem.measurement, problem.measurement.n
    tally, residual, refused = EvaluationCount.zeros(1), np.full(len(given.z), np.nan), ""
    if np.isfinite(estimates.x).all():
        # Far from the truth a model may overflow or refuse: then nothing is known of the residuals.
        with np.errstate(all="ignore"):
            h = CountingModel(model, tally).simulate(estimates.x, np.arange(1))[0]
            residual = given.z - model.near(h, given.z)
            if not np.isfinite(residual).all():
                refused = "the model has no finite readings at this estimate"
    if tally.messages:
        refused = f"the residuals are unknown: {tally.messages[0]}"
    return Fit(
        label=label,
        estimator=estimator,
        given=given,
        status=Status(int(estimates.status[0])),
        message=estimates.messages.get(0, refused),
        model=model,
        assumed=problem,
        inner=estimates.x[0],
        inner_covariance=np.full((n, n), np.nan) if estimates.covariance is None else estimates.covariance[0],
        residual=residual,
        iterations=int(estimates.iterations[0]),
        simulations=float(estimates.simulations[0] + model.jacobian_cost * estimates.jacobians[0]),
    )


def undetermined(model: Measurement, J: Array, x: Array) -> tuple[str, ...]:
    """Finds the combinations of parameters that whitened readings of slopes J (m, n) do not determine at x (n,): errors
    along them are larger than the parameters."""
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
    """Places values of some of m readings among all; NaN for the others."""
    whole = np.full(m, np.nan)
    whole[rows] = values
    return whole
