"""What can be signed of an answer beyond its standard errors: intervals that follow the bends of the model, what the
readings say least of, which of them carry the answer, and whether another answer fits as well.

One least-squares minimum is examined, whichever estimator found it, and one with the prior where estimators are told
one. Profiles have a page of their own, and so has the prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, deviations
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.least_squares import Minima, inverse_factor
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.fits import Fit, at_rows, falls_beyond, holding, scaled
from ipe_bench.real.levels import Levelled, maximum, minimise, objective_of
from ipe_bench.real.penalised import penalised
from ipe_bench.real.profiles import (
    CONFIDENCE,
    Profile,
    Released,
    half_width,
    joint_region,
    natural_limits,
    profiles,
    wald_interval,
)

BOOTSTRAPS = 500
STARTS = 64
"""Points that the search for other minima begins from."""
_SPREADS = (1.0, 3.0)
"""Multiples of the prior's deviations with which these points are drawn, half of them with each."""
_WORK = 20_000_000
"""Entries of Jacobians that one iteration of all draws or starts may come to: of very many readings there are fewer."""
_FEWEST = 4
"""The least number of draws or starts."""
_SAME = 1e-2
"""Minima closer than this, in standard errors of either, are one."""


@dataclass(frozen=True)
class Minimum:
    """A minimum of the sum of squares."""

    x: Array
    """(n,) in the parameters' own units."""
    chi_square: float
    found: int
    """From how many of the starts."""
    as_good: bool
    """Whether the readings do not tell it from the least one: their joint confidence region holds it."""


@dataclass(frozen=True)
class Direction:
    """The combination of parameters that the readings say least of."""

    weights: Array
    """(n,): by how many of its own units each parameter changes along it; the readings hardly change."""
    collinearity: float
    """How many times larger the errors are than if the parameters acted on the readings each in its own way: the
    collinearity index of Brun, Reichert and Künsch, Water Resources Research 37, 2001; above 10 to 15 the readings do
    not tell the parameters apart."""


@dataclass(frozen=True)
class Influence:
    """What single readings do to the answer; all (m,), NaN where a reading is missing."""

    leverage: Array
    """The share of a reading's error that the fit follows, from 0 to 1."""
    cook: Array
    """Cook's distance (Technometrics 19, 1977): how far the answer moves without the reading, in its own region."""
    shift: Array
    """By how many standard errors the parameter that moves most moves without the reading."""


@dataclass(frozen=True)
class Bootstrap:
    """Answers to simulated readings of the model as estimated."""

    low: Array
    high: Array
    """Percentile intervals (n,) in the parameters' own units."""
    bias: Array
    """Mean of the answers less the estimate (n,), to second order."""
    converged: int
    drawn: int


@dataclass(frozen=True)
class OnBound:
    """A parameter whose estimate is on a bound, because the readings want it beyond."""

    parameter: Parameter
    bound: float
    other: float
    """The end of its profile interval that is not the bound; infinite where the readings set no limit, NaN where it was
    not found."""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """An answer with all that is known of it."""

    label: str
    """The estimator whose answer it is."""
    model: Measurement
    x: Array
    """The least-squares estimate (n,) in the parameters' own units."""
    standard_errors: Array
    wald: tuple[Array, Array]
    """The intervals (n,), (n,) from the standard errors."""
    profiles: list[Profile]
    """The profile of each parameter, with its interval."""
    bootstrap: Bootstrap
    direction: Direction
    influence: Influence
    fitted: Array
    """h (m,) at the estimate, where readings are missing too."""
    fitted_errors: Array
    """Standard errors (m,) of `fitted`: the band of the prediction is `half_width` times these."""
    new_errors: Array
    """Standard errors (m,) of a further reading, with its noise; NaN where that is not known."""
    half_width: float
    minima: list[Minimum]
    """All that were found, the least first."""
    least: bool
    """Whether the estimate is the least minimum that was found."""
    on_bounds: tuple[OnBound, ...] = ()
    """Parameters that are held on their bounds, which are not among the others."""
    with_prior: bool = False
    """Whether it is the minimum with the prior; see `penalised`. Then its intervals count the prior, too."""

    @property
    def ambiguous(self) -> list[Minimum]:
        """Other minima that fit as well."""
        apart = _SAME * self.standard_errors
        return [one for one in self.minima if one.as_good and (np.abs(one.x - self.x) > apart).any()]


def examinations(problem: Problem, z: Array, fits: list[Fit]) -> tuple[Examination, ...]:
    """Of the least-squares minimum, and of that with the prior: those that estimators have found."""
    found = examine(problem, z, fits), examine(problem, z, fits, with_prior=True)
    return tuple(one for one in found if one is not None)


def examine(
    problem: Problem, z: Array, fits: list[Fit], *, with_prior: bool = False, bootstraps: int = BOOTSTRAPS
) -> Examination | None:
    """Examines the least of the minima that the estimators found, or of those that estimators `with_prior` did; None
    where none of them found one."""
    told = [one for one in fits if one.status is Status.CONVERGED and np.isfinite(one.chi_square)]
    told = [one for one in told if one.with_prior == with_prior]
    rows = np.flatnonzero(np.isfinite(z))
    if not told or (with_prior and problem.prior_deviation is None):
        return None
    if with_prior:
        best = min(told, key=lambda one: _sum_with_prior(problem, one))
        least = _Least.near(*penalised(best.assumed, z[rows], best.prior_inflation), best, readings=len(rows))
        return None if least is None else least.examined(best.label, problem, rows, bootstraps)
    best = min(told, key=lambda one: one.deviance)
    whole, on_bounds = best.assumed, best.held_at
    if best.held is not None:
        # What is on its bound has no error; the others are examined with it held there.
        problem, best = holding(problem, on_bounds), best.held
    least = _Least.near(best.assumed, z[rows], best)
    if least is None:
        return None
    released = _released(whole, least, on_bounds) if on_bounds else None
    found = least.examined(best.label, problem, rows, bootstraps, released)
    return replace(found, on_bounds=tuple(_on_bounds(whole, least, on_bounds)))


def _sum_with_prior(problem: Problem, one: Fit) -> float:
    prior = problem.prior_covariance(one.prior_inflation)
    assert prior is not None
    x = one.inner[: len(problem.x0)]
    return one.deviance / (one.level or 1.0) ** 2 + float(np.sum(prior.whiten(x - problem.x0) ** 2))


def _released(problem: Problem, least: _Least, values: Mapping[int, float]) -> Released | None:
    """The problem in which what is on bounds may leave them; None where nothing is known of it there."""
    places = np.array(list(values))
    start = problem.measurement.physical(problem.measurement.nominal[None])[0]
    given = replace(problem, measurement=problem.measurement.unbounded(values))
    x = np.array(given.measurement.nominal, dtype=float)
    x[np.setdiff1d(np.arange(len(x)), places)] = least.x
    with np.errstate(all="ignore"):
        inverse_U = inverse_factor(objective_of(given, least.z[None]).jacobian(x[None]))[0]
    if not np.isfinite(inverse_U).all():
        return None
    inwards = np.sign(start[places] - np.array(list(values.values())))
    return Released(given, x, inverse_U @ inverse_U.T, places, inwards)


def _on_bounds(problem: Problem, least: _Least, values: Mapping[int, float]) -> Iterator[OnBound]:
    """What the readings say of each parameter on its bound, the others being held on theirs."""
    model = problem.measurement
    lower, upper = natural_limits(model)
    for place, bound in values.items():
        others = {k: value for k, value in values.items() if k != place}
        k = place - sum(other < place for other in others)
        part = _released(holding(problem, others) if others else problem, least, {k: bound})
        other = np.nan
        if part is not None:
            sign, asked = int(part.inwards[0]), (part.problem, least.z[None], part.x[None], part.P[None])
            freedom = least.freedom
            if isinstance(freedom, np.ndarray):
                freedom = np.insert(freedom, k, freedom.min())
            ((found,),) = profiles(*asked, freedom=freedom, places=(k,), signs=(sign,))
            other = np.nan if found.lower_minimum else (found.low, found.high)[sign > 0]
        yield OnBound(model.physical_parameters[place], bound, float(np.clip(other, lower[place], upper[place])))


@dataclass(frozen=True)
class _Least:
    """A least-squares minimum x (n,) of present readings z (m,), R being known or as estimated."""

    problem: Problem
    z: Array
    x: Array
    P: Array
    chi_square: float
    freedom: int | Array | None
    """Degrees of freedom that the level of the noise is estimated from, or (n,) those behind the variances where x has
    several levels; None where it is known."""
    readings: int
    """How many of z are readings: the others are the prior's means."""

    @classmethod
    def near(cls, problem: Problem, z: Array, best: Fit, *, readings: int | None = None) -> _Least | None:
        if best.estimated is not None and readings is None:
            found = maximum(best.estimated, z)
            if not found.converged or not (np.diag(found.P) > 0).all():
                return None
            chi_square = float(np.sum(found.problem.R.whiten(z - found.fitted) ** 2))
            return cls(found.problem, z, found.x, found.P, chi_square, found.freedom, len(z))
        minima = minimise(problem, z[None], best.inner[None, : problem.measurement.n])
        if not minima.converged[0] or not (np.diag(minima.covariance[0]) > 0).all():
            return None
        free, readings = best.degrees_of_freedom, len(z) if readings is None else readings
        if best.level is not None and readings == len(z):
            # The minimum's own level, where the estimator's was a little higher.
            factor = float(np.sqrt(minima.chi_square[0] / free))
            problem = scaled(problem, factor)
            minima = replace(minima, covariance=minima.covariance * factor**2, chi_square=minima.chi_square / factor**2)
        level = None if best.level is None else free
        return cls(problem, z, minima.x[0], minima.covariance[0], float(minima.chi_square[0]), level, readings)

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
        return self.x[None, : self._mean.n]

    @cached_property
    def fitted(self) -> Array:
        """h (m,) of the readings that are there."""
        return self._mean.simulate(self._place)[0]

    @cached_property
    def J(self) -> Array:
        """The whitened Jacobian (m, n) of that model."""
        return self.problem.R.whiten_jacobian(self._mean.jacobian(self._place))[0]

    def examined(
        self, label: str, whole: Problem, rows: Array, bootstraps: int, released: Released | None = None
    ) -> Examination:
        """`whole`: the problem with the readings that are missing, of which the present ones are `rows`; `released`:
        that in which parameters held on bounds may leave them."""
        model, x, m = self.model, self.x[None], whole.R.m
        q = half_width(CONFIDENCE, self.freedom)
        deviation = np.sqrt(np.diag(self.P))
        h, raw = whole.measurement.simulate(self._place)[0], whole.measurement.jacobian(self._place)[0]
        inner = self.P[: raw.shape[1], : raw.shape[1]]
        errors = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", raw, inner, raw), 0.0))
        known = self.problem.R.deviations[: self.readings]
        deviations = at_rows(rows, known, m)
        if np.ptp(known) == 0:
            # Where all readings are as good, so is one that is missing; else nobody knows.
            deviations[:] = known[0]
        minima = self.minima()
        return Examination(
            label=label,
            model=model,
            x=model.physical(x)[0],
            standard_errors=deviation * np.abs(model.physical_slope(x)[0]),
            wald=wald_interval(model, self.x, deviation, q),
            profiles=profiles(
                self.problem, self.z[None], x, self._P_apart[None], freedom=self.freedom, released=released
            )[0],
            bootstrap=self.bootstrap(bootstraps, released),
            direction=self.direction(),
            influence=self.influence(rows, m),
            fitted=h,
            fitted_errors=errors,
            new_errors=np.hypot(errors, deviations),
            half_width=float(np.max(q)),
            minima=minima,
            least=self.chi_square <= minima[0].chi_square + 1e-6 * max(1.0, self.chi_square),
            with_prior=self.readings < len(self.z),
        )

    @property
    def _P_apart(self) -> Array:
        """P (n, n) for the starts of profiles: the logarithm of a level does not follow a straight line."""
        n, P = self.J.shape[1], np.diag(np.diag(self.P))
        P[:n, :n] = self.P[:n, :n]
        return P

    def direction(self) -> Direction:
        size = np.linalg.norm(self.J, axis=0)
        _, s, V = np.linalg.svd(self.J / size, full_matrices=False)
        weights = np.zeros(len(self.x))
        weights[: len(size)] = V[-1] / size * self._mean.physical_slope(self._place)[0]
        leading = np.argmax(np.abs(V[-1]))
        return Direction(weights * np.sign(weights[leading]), float(1.0 / s[-1]))

    def influence(self, rows: Array, m: int) -> Influence:
        """By the linear model about the estimate (Cook and Weisberg, Residuals and Influence in Regression, 1982)."""
        n = self.J.shape[1]
        P = self.P[:n, :n]
        Q, _ = np.linalg.qr(self.J)
        w = self.problem.R.whiten(self.z - self.fitted)
        leverage = np.sum(Q**2, axis=1)
        with np.errstate(all="ignore"):
            left = np.where(leverage < 1 - 1e-9, 1 - leverage, np.nan)
            cook = w**2 * leverage / (n * left**2)
            moved = P @ self.J.T * (w / left)
        shift = np.abs(moved / np.sqrt(np.diag(P))[:, None]).max(axis=0)
        return Influence(*(at_rows(rows, values[: self.readings], m) for values in (leverage, cook, shift)))

    def bootstrap(self, draws: int, released: Released | None = None) -> Bootstrap:
        """Estimates from readings simulated at the estimate, started there, with noise of R; the draws are always the
        same ones (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 6.5).

        Where the level of the noise is estimated, each set has a level of its own: what the true one may be, given the
        estimate, so that intervals are those of Student's t where the model is linear. A set whose minimum is on a
        bound has its answer there, and parameters that are held on bounds may leave them.
        """
        rng = np.random.Generator(np.random.Philox(0))
        draws = _affordable(draws, self.J.size)
        factor = self.problem.R.factor
        e = rng.standard_normal((draws, len(self.z)))
        level = np.ones(draws)
        if isinstance(self.freedom, int):
            level = np.sqrt(self.freedom / rng.chisquare(self.freedom, draws))
        e[:, : self.readings] *= level[:, None]
        z = self.fitted + (e * factor if factor.ndim == 1 else e @ factor.T)
        if released is None:
            values, answered = answers(self.problem, z, np.repeat(self.x[None], draws, axis=0))
        else:
            values, answered = answers(released.problem, z, np.repeat(released.x[None], draws, axis=0), released)
            values = np.delete(values, released.places, axis=1)
        values = values[answered]
        tail = (1 - CONFIDENCE) / 2
        n, estimate = len(self.x), self.model.physical(self.x[None])[0]
        if len(values) < draws / 2:
            unknown = np.full(n, np.nan)
            return Bootstrap(unknown, unknown, unknown, len(values), draws)
        low, high = np.quantile(values, [tail, 1 - tail], axis=0)
        # Bias grows with the square of the level: this is that of the level that was estimated.
        bias = ((values - estimate) / level[answered, None] ** 2).mean(axis=0)
        return Bootstrap(low, high, bias, len(values), draws)

    def minima(self) -> list[Minimum]:
        """Minima reached from starts that the prior draws about the nominal point, and the estimate."""
        n, problem = len(self.x), self.problem
        rng = np.random.Generator(np.random.Philox(1))
        spread = np.ones(n) if problem.prior_deviation is None else problem.prior_deviation
        reach = np.repeat(_SPREADS, _affordable(STARTS, self.J.size) // len(_SPREADS))[:, None]
        starts = np.concatenate([self.x[None], problem.x0 + reach * spread * rng.standard_normal((len(reach), n))])
        minima = minimise(problem, np.repeat(self.z[None], len(starts), axis=0), starts)
        return self._told_apart(minima)

    def _told_apart(self, minima: Minima) -> list[Minimum]:
        freedom = self.freedom if isinstance(self.freedom, int) else None
        limit = joint_region(len(self.x), CONFIDENCE, freedom)
        usable = minima.converged & np.isfinite(minima.chi_square) & np.isfinite(minima.covariance).all(axis=(1, 2))
        order = np.flatnonzero(usable)[np.argsort(minima.chi_square[usable], kind="stable")]
        found: list[Minimum] = []
        places: list[tuple[Array, Array]] = []
        for i in order:
            x, deviation = minima.x[i], deviations(minima.covariance[i])
            near = [k for k, (y, d) in enumerate(places) if (np.abs(x - y) <= _SAME * np.maximum(d, deviation)).all()]
            if near:
                found[near[0]] = replace(found[near[0]], found=found[near[0]].found + 1)
                continue
            chi_square = float(minima.chi_square[i])
            least = found[0].chi_square if found else chi_square
            places.append((x, deviation))
            found.append(Minimum(self.model.physical(x[None])[0], chi_square, 1, chi_square - least <= limit))
        return found or [Minimum(self.model.physical(self.x[None])[0], self.chi_square, 1, True)]


def answers(problem: Problem, z: Array, x: Array, released: Released | None = None) -> tuple[Array, Mask]:
    """The least-squares estimates (sets, n) within the bounds, in the parameters' own units, for readings z (sets, m)
    from x (sets, n), and which sets have one; parameters that are `released` have the bounds where they stood."""
    minima, model = minimise(problem, z, x), problem.measurement
    values, found = model.physical(minima.x), minima.converged.copy()
    on_bounds: dict[tuple[tuple[int, float], ...], list[int]] = {}
    outside, bounds = np.zeros((len(x), 0), dtype=bool), np.zeros(0)
    if released is not None:
        outside = ~released.inside(minima.x)
        bounds = model.physical(released.x[None])[0, released.places]
    for i in np.flatnonzero(~found | outside.any(axis=1)):
        near = dict(model.near_bounds(minima.x[i]))
        if released is not None:
            near |= dict(zip(released.places[outside[i]].tolist(), bounds[outside[i]].tolist(), strict=True))
        found[i] = False
        if 0 < len(near) < model.n:
            on_bounds.setdefault(tuple(sorted(near.items())), []).append(int(i))
    for key, sets in on_bounds.items():
        near = dict(key)
        free = [k for k in range(model.n) if k not in near]
        held = holding(problem, near)
        there = minimise(held, z[sets], np.ascontiguousarray(minima.x[sets][:, free]))
        least = there.converged & falls_beyond(problem, there.x, near, z[sets], released)
        values[sets] = np.array([near.get(k, np.nan) for k in range(model.n)])
        values[np.ix_(sets, free)] = held.measurement.physical(there.x)
        found[sets] = least
    return values, found


def _affordable(wanted: int, entries: int) -> int:
    """How many minimisations to make of a Jacobian with so many entries."""
    return min(wanted, max(_FEWEST, _WORK // entries))
