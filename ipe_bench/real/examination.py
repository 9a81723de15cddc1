"""Examines a least-squares minimum beyond its standard errors: intervals that follow the bends of the model, which
readings carry the answer, and whether another answer fits as well."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, deviations
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.least_squares import inverse_factor
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.fits import FAR_BELOW, Fit, at_rows, falls_beyond, holding, scaled
from ipe_bench.real.levels import Levelled, maximise_likelihood, maximum, objective_of
from ipe_bench.real.profiles import (
    CONFIDENCE,
    Released,
    half_width,
    joint_region,
    natural_limits,
    profiles,
    wald_interval,
)
from ipe_bench.real.residuals import tested

BOOTSTRAPS = 500
STARTS = 64
"""Points that the search for other minima begins from."""
_SPREADS = (1.0, 3.0)
"""Multiples of the prior's deviations with which these points are drawn, half of them with each."""
_WORK = 20_000_000
"""The most entries of Jacobians in one iteration of all draws or starts: there are fewer of very many readings."""
_FEWEST = 4
"""The least number of draws or starts."""
_SAME = 1e-2
"""Minima closer than this, in standard errors of either, are one."""
_LOWER = 1e-6
"""Sums of squares that differ by less than this share, or number, are those of one minimum."""
_SAME_READINGS = 1e-4
"""Answers whose readings differ by less than this, in standard deviations, are of one curve."""
_BENT = 0.1
"""Share of the half-width by which the ends of a bent profile differ from those of the standard error."""


@dataclass(frozen=True)
class Minimum:
    """Holds a minimum of the sum of squares."""

    x: Array
    """(n,) in the parameters' own units."""
    chi_square: float
    as_good: bool
    """Whether the readings do not tell it from the least one: their joint confidence region holds it."""
    same_readings: bool = False
    """Whether its readings are those of the estimate, so that no readings at all tell it from that."""


@dataclass(frozen=True)
class BootstrapIntervals:
    """Holds percentile intervals of answers to simulated readings of the model as estimated."""

    low: Array
    """Lower ends (n,) of percentile intervals, in the parameters' own units."""
    high: Array
    converged: int
    drawn: int


@dataclass(frozen=True)
class OnBound:
    """Describes a parameter whose estimate is on a bound, because the readings want it beyond."""

    parameter: Parameter
    bound: float
    other: float
    """The other end of its profile interval; infinite if the readings set no limit, NaN if it was not found."""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """Examines a least-squares minimum; intervals and estimates are in the parameters' own units."""

    label: str
    """The estimator whose answer it is."""
    whole: Problem
    """The problem with the readings that are missing."""
    rows: Array
    """The readings that are present."""
    problem: Problem
    """Their problem, with R as it is known or estimated."""
    z: Array
    inner: Array
    """The estimate (n,) in the coordinates of the model."""
    P: Array
    """Its covariance (n, n)."""
    chi_square: float
    freedom: int | Array | None
    """Degrees of freedom behind the level of the noise, or (n,) behind each variance; None if R is known."""
    bootstraps: int
    overstated: bool = False
    """Whether the residuals are so far below the stated noise that no interval by chi-square means anything."""
    released: Released | None = None
    """The problem in which parameters that are held on bounds may leave them."""
    on_bounds: tuple[OnBound, ...] = ()
    """Parameters that are held on their bounds, which are not among the others."""

    @property
    def model(self) -> Measurement:
        return self.problem.measurement

    @property
    def _mean(self) -> Measurement:
        """The model without levels of the noise."""
        return self.model.whole if isinstance(self.model, Levelled) else self.model

    @property
    def _place(self) -> Array:
        """The parameters (1, n) of that model."""
        return self.inner[None, : self._mean.n]

    @cached_property
    def _present(self) -> Array:
        """h (m,) of the readings that are present."""
        return self._mean.near(self._mean.simulate(self._place)[0], self.z)

    @cached_property
    def _J(self) -> Array:
        """The whitened Jacobian (m, n) of that model."""
        return self.problem.R.whiten_jacobian(self._mean.jacobian(self._place))[0]

    @cached_property
    def x(self) -> Array:
        """The least-squares estimate (n,)."""
        return self.model.physical(self.inner[None])[0]

    @property
    def standard_errors(self) -> Array:
        return np.sqrt(np.diag(self.P)) * np.abs(self.model.physical_slope(self.inner[None])[0])

    @cached_property
    def wald(self) -> tuple[Array, Array]:
        """The intervals (n,), (n,) from the standard errors; NaN for levels of the noise."""
        q = half_width(CONFIDENCE, self.freedom)
        return self._without_levels(
            *wald_interval(self.model, self.inner, np.sqrt(np.diag(self.P)), q)
        )

    def _without_levels(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Intervals (n,), (n,) without those of levels of the noise: only a profile holds a level as often as it
        says."""
        levels = np.arange(len(low)) >= self._mean.n
        return np.where(levels, np.nan, low), np.where(levels, np.nan, high)

    @cached_property
    def profiles(self) -> tuple[Array, Array]:
        """The profile intervals (n,), (n,); an end is infinite if the readings set no limit."""
        # The logarithm of a level does not follow a straight line.
        n, P = self._mean.n, np.diag(np.diag(self.P))
        P[:n, :n] = self.P[:n, :n]
        return profiles(
            self.problem, self.z, self.inner, P, freedom=self.freedom, released=self.released
        )

    @property
    def bent(self) -> Mask:
        """The parameters (n,) whose profile intervals are not those of the standard errors."""
        (low, high), (low_wald, high_wald) = self.profiles, self.wald
        with np.errstate(invalid="ignore"):
            apart = np.maximum(np.abs(low - low_wald), np.abs(high - high_wald))
            return ~(apart <= _BENT * (high_wald - low_wald) / 2) & (
                np.arange(len(low)) < self._mean.n
            )

    @cached_property
    def fitted(self) -> Array:
        """h (m,) at the estimate, where readings are missing too."""
        return self.whole.measurement.simulate(self._place)[0]

    @cached_property
    def fitted_errors(self) -> Array:
        """Standard errors (m,) of `fitted`."""
        J = self.whole.measurement.jacobian(self._place)[0]
        P = self.P[: J.shape[1], : J.shape[1]]
        return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", J, P, J), 0.0))

    @property
    def new_errors(self) -> Array:
        """Standard errors (m,) of a further reading, with its noise; NaN if that is not known."""
        known = self.problem.R.deviations
        # If all readings are as good, so is one that is missing.
        same = np.ptp(known) <= 1e-12 * known[0]
        return np.hypot(
            self.fitted_errors, known[0] if same else at_rows(self.rows, known, self.whole.R.m)
        )

    @cached_property
    def shift(self) -> Array:
        """The move (m,) without a reading of the parameter that moves most, in standard errors, by the linear model
        about the estimate (Cook and Weisberg, Residuals and Influence in Regression, 1982); NaN if it is missing."""
        n, R = self._J.shape[1], self.problem.R
        P, w = self.P[:n, :n], R.whiten(self.z - self._present)
        statistic, variance = tested(w, np.linalg.qr(self._J)[0], R)
        slopes = self._J if R.factor.ndim == 1 else R.whiten(np.eye(len(w))) @ self._J
        with np.errstate(all="ignore"):
            moved = P @ slopes.T * (statistic / variance)
            return at_rows(
                self.rows, np.abs(moved / np.sqrt(np.diag(P))[:, None]).max(axis=0), self.whole.R.m
            )

    @cached_property
    def bootstrap(self) -> BootstrapIntervals:
        """Estimates within the bounds from readings simulated at the estimate with noise of R, always the same draws
        (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 6.5).

        If the level of the noise is estimated, each set has a level that the true one may be, given the estimate, so
        that intervals are those of Student's t if the model is linear.
        """
        rng, draws, free = (
            np.random.Generator(np.random.Philox(0)),
            self._affordable(self.bootstraps),
            self.released,
        )
        e = rng.standard_normal((draws, len(self.z)))
        if isinstance(self.freedom, int):
            e *= np.sqrt(self.freedom / rng.chisquare(self.freedom, draws))[:, None]
        factor = self.problem.R.factor
        z = self._present + (e * factor if factor.ndim == 1 else e @ factor.T)
        problem, x = (self.problem, self.inner) if free is None else (free.problem, free.x)
        values, answered = answers(problem, z, np.repeat(x[None], draws, axis=0), free)
        values = np.delete(values, [] if free is None else free.places, axis=1)[answered]
        if len(values) < draws / 2:
            unknown = np.full(len(self.x), np.nan)
            return BootstrapIntervals(unknown, unknown, len(values), draws)
        tail = (1 - CONFIDENCE) / 2
        low, high = self._without_levels(*np.quantile(values, [tail, 1 - tail], axis=0))
        return BootstrapIntervals(low, high, len(values), draws)

    def _affordable(self, wanted: int) -> int:
        return min(wanted, max(_FEWEST, _WORK // self._J.size))

    @cached_property
    def minima(self) -> list[Minimum]:
        """Minima, the least first, reached from the estimate and from starts that the prior draws."""
        n, problem = len(self.inner), self.problem
        rng = np.random.Generator(np.random.Philox(1))
        spread = np.ones(n) if problem.prior_deviation is None else problem.prior_deviation
        reach = np.repeat(_SPREADS, self._affordable(STARTS) // len(_SPREADS))[:, None]
        drawn = problem.x0 + reach * spread * rng.standard_normal((len(reach), n))
        starts = np.concatenate([self.inner[None], drawn])
        minima = maximise_likelihood(problem, np.repeat(self.z[None], len(starts), axis=0), starts)
        limit = joint_region(n, CONFIDENCE, self.freedom if isinstance(self.freedom, int) else None)
        usable = (
            minima.converged
            & np.isfinite(minima.chi_square)
            & np.isfinite(minima.covariance).all(axis=(1, 2))
        )
        found: list[Minimum] = []
        places: list[tuple[Array, Array]] = []
        for i in np.flatnonzero(usable)[np.argsort(minima.chi_square[usable], kind="stable")]:
            x, deviation = minima.x[i], deviations(minima.covariance[i])
            if any((np.abs(x - y) <= _SAME * np.maximum(d, deviation)).all() for y, d in places):
                continue
            chi_square = float(minima.chi_square[i])
            least = found[0].chi_square if found else chi_square
            places.append((x, deviation))
            with np.errstate(all="ignore"):
                moved = self._mean.simulate(x[None, : self._mean.n])[0] - self._present
            same = bool((np.abs(self.problem.R.whiten(moved)) < _SAME_READINGS).all())
            found.append(
                Minimum(
                    self.model.physical(x[None])[0], chi_square, chi_square - least <= limit, same
                )
            )
        return found or [Minimum(self.x, self.chi_square, True)]

    @property
    def least(self) -> bool:
        """Tells whether the estimate is the least minimum that was found."""
        return self.chi_square <= self.minima[0].chi_square + _LOWER * max(1.0, self.chi_square)

    @property
    def ambiguous(self) -> list[Minimum]:
        """Other minima that fit as well."""
        apart = _SAME * self.standard_errors
        return [
            one for one in self.minima if one.as_good and (np.abs(one.x - self.x) > apart).any()
        ]


def examine(
    problem: Problem, z: Array, fits: list[Fit], *, bootstraps: int = BOOTSTRAPS
) -> Examination | None:
    """Examines the least of the minima that estimators without a prior found, of several that found it the first that
    passes; None if none of them found one."""
    told = [
        one
        for one in fits
        if one.status is Status.CONVERGED and np.isfinite(one.chi_square) and not one.with_prior
    ]
    best = min(told, key=lambda one: one.deviance, default=None)
    if best is None:
        return None
    near = best.deviance + _LOWER * max(1.0, abs(best.deviance))
    best = next(
        (one for one in told if one.passes and one.deviance <= near and _least_squares(one)), best
    )
    values, rows = best.held_at, np.flatnonzero(np.isfinite(z))
    if values:
        problem = holding(problem, values)
    if best.estimated is not None:
        levelled = maximum(best.estimated, z[rows])
        inner, assumed, P, freedom = levelled.x, levelled.problem, levelled.P, levelled.freedom
        converged = levelled.converged
        chi_square = float(
            np.sum(assumed.R.whiten(z[rows] - levelled.model.near(levelled.fitted, z[rows])) ** 2)
        )
    else:
        assumed = best.assumed
        minima = maximise_likelihood(assumed, z[None, rows], best.inner[None])
        inner, P, chi_square = minima.x[0], minima.covariance[0], float(minima.chi_square[0])
        converged, freedom = bool(minima.converged[0]), None
        if best.level is not None:
            # The minimum's own level, where the estimator's was a little higher.
            freedom = best.degrees_of_freedom
            factor = float(np.sqrt(chi_square / freedom))
            assumed, P, chi_square = scaled(assumed, factor), P * factor**2, chi_square / factor**2
    if not converged or not (np.diag(P) > 0).all():
        return None
    found = Examination(
        label=best.label,
        whole=problem,
        rows=rows,
        problem=assumed,
        z=z[rows],
        inner=inner,
        P=P,
        chi_square=chi_square,
        freedom=freedom,
        bootstraps=bootstraps,
        overstated=best.overstated >= FAR_BELOW,
    )
    if not values:
        return found
    outer = Problem(best.model, best.assumed.R)
    return replace(
        found,
        released=_released(outer, found, values),
        on_bounds=tuple(_on_bounds(outer, found, values)),
    )


def _least_squares(one: Fit) -> bool:
    return one.estimator.equation == "least_squares"


def _released(problem: Problem, found: Examination, values: Mapping[int, float]) -> Released | None:
    """Returns the problem in which parameters held at `values` may leave them; None if it has no covariance there."""
    places, bounds = np.array(list(values)), np.array(list(values.values()))
    start = problem.measurement.physical(problem.measurement.nominal[None])[0]
    given = replace(problem, measurement=problem.measurement.stating("nominal", values))
    x = np.array(given.measurement.nominal, dtype=float)
    x[np.setdiff1d(np.arange(len(x)), places)] = found.inner
    with np.errstate(all="ignore"):
        inverse_U = inverse_factor(objective_of(given, found.z[None]).jacobian(x[None]))[0]
    if not np.isfinite(inverse_U).all():
        return None
    return Released(given, x, inverse_U @ inverse_U.T, places, np.sign(start[places] - bounds))


def _on_bounds(
    problem: Problem, found: Examination, values: Mapping[int, float]
) -> Iterator[OnBound]:
    """Computes the interval of each parameter on its bound, the others being held on theirs."""
    lower, upper = natural_limits(problem.measurement)
    for place, bound in values.items():
        others = {k: value for k, value in values.items() if k != place}
        k, other = place - sum(one < place for one in others), np.nan
        part = _released(holding(problem, others) if others else problem, found, {k: bound})
        if part is not None:
            sign, freedom = int(part.inwards[0]), found.freedom
            if isinstance(freedom, np.ndarray):
                freedom = np.insert(freedom, k, freedom.min())
            ends = profiles(
                part.problem, found.z, part.x, part.P, freedom=freedom, places=(k,), signs=(sign,)
            )
            other = float(np.clip(ends[int(sign > 0)][0], lower[place], upper[place]))
        yield OnBound(problem.measurement.physical_parameters[place], bound, other)


def answers(
    problem: Problem, z: Array, x: Array, released: Released | None = None
) -> tuple[Array, Mask]:
    """Computes the least-squares estimates (sets, n) within the bounds, in the parameters' own units, for readings z
    (sets, m) from x (sets, n), and the sets that have one; `released` parameters keep their bounds."""
    minima, model = maximise_likelihood(problem, z, x), problem.measurement
    values, found = model.physical(minima.x), minima.converged.copy()
    outside, bounds = np.zeros((len(x), 0), dtype=bool), np.zeros(0)
    if released is not None:
        outside, bounds = (
            ~released.inside(minima.x),
            model.physical(released.x[None])[0, released.places],
        )
    on_bounds: dict[tuple[tuple[int, float], ...], list[int]] = {}
    for i in np.flatnonzero(~found | outside.any(axis=1)):
        near = dict(model.near_bounds(minima.x[i]))
        if released is not None:
            near |= dict(
                zip(released.places[outside[i]].tolist(), bounds[outside[i]].tolist(), strict=True)
            )
        found[i] = False
        if 0 < len(near) < model.n:
            on_bounds.setdefault(tuple(sorted(near.items())), []).append(int(i))
    for key, sets in on_bounds.items():
        near = dict(key)
        free = [k for k in range(model.n) if k not in near]
        held = holding(problem, near)
        there = maximise_likelihood(held, z[sets], np.ascontiguousarray(minima.x[sets][:, free]))
        found[sets] = there.converged & falls_beyond(problem, there.x, near, z[sets], released)
        values[sets] = np.array([near.get(k, np.nan) for k in range(model.n)])
        values[np.ix_(sets, free)] = held.measurement.physical(there.x)
    return values, found
