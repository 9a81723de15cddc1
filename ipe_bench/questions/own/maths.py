"""Simulates readings like a user's own, and counts which estimators find the best fit and whether
their error bars contain the truth.

Truths are the estimate, at every minimum that fits (a parametric bootstrap: Efron and Tibshirani,
An Introduction to the Bootstrap, 1993, section 6.5); times and noise are those of the readings, and
estimators start where the user does. The prior of an estimator is no part of the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Mask, deviations
from ipe_bench.basics.streams import numbered
from ipe_bench.estimators.base import Estimates, Estimator, estimate_safely
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.counted import CountingModel, EvaluationCount, cost
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.measurements.problem import Problem
from ipe_bench.questions.own.levels import Reported, by_levels
from ipe_bench.real.estimation import Question
from ipe_bench.real.examination import Examination
from ipe_bench.real.fits import Fit, scaled
from ipe_bench.real.profiles import CONFIDENCE, half_width
from ipe_bench.report.progress import Shows, counting
from ipe_bench.report.words import from_to
from ipe_bench.statistics.intervals import clopper_pearson
from ipe_bench.trials.thresholds import FIT_LEVEL

MOST_POINTS = 3
"""Minima that are simulated at most."""
SIZES = (1.0, 10.0)
"""Deviations of the prior in sizes of the start, where a user states none."""
_SAME_CURVE = 1e-3
"""Answers whose readings differ by less than this, in standard deviations, are of one curve."""
_AT_ONCE = 25
"""Data sets between two words on progress."""
_NOISE = 1
"""The random stream of a trial's noise, as in `ipe_bench.trials.scenario`."""


@dataclass(frozen=True)
class Claim:
    """Holds what simulated data sets say of one estimator."""

    label: str
    told: str
    """The prior that it was given; empty if it takes none."""
    trials: int
    found: int
    """Data sets in which it found the best fit, or kept the track."""
    inside: tuple[int, ...]
    """Data sets in which the 95 % interval held the truth, for each parameter."""
    worst: str
    """That parameter."""
    factor: float
    """Times by which that interval is too narrow: the 95 % quantile of error over half-width."""
    cost: float
    """Median evaluations of the model, a Jacobian counting as many as it costs."""
    seconds: float
    """Mean time of a data set."""

    @classmethod
    def of(
        cls, label: str, told: str, found: Mask, ratio: Array, names: Sequence[str], **spent: float
    ) -> Claim:
        """Counts the trials (trials,) in which an estimator found what it should, and those in
        which errors over half-widths (trials, n) are at most 1."""
        inside = (ratio <= 1.0).sum(axis=0)
        worst = int(inside.argmin())
        factor = float(np.quantile(ratio[:, worst], CONFIDENCE, method="higher"))
        counts = (len(ratio), int(np.sum(found)), tuple(inside.tolist()))
        return cls(label, told, *counts, names[worst], factor, **spent)

    @property
    def finds(self) -> float:
        return self.found / self.trials

    @property
    def held(self) -> int:
        """Data sets in which the interval of the worst parameter held the truth."""
        return min(self.inside)

    @property
    def holds(self) -> float:
        return self.held / self.trials

    @property
    def holds_between(self) -> tuple[float, float]:
        """The 95 % interval of the share of the worst parameter, whichever that is: each share has
        an interval that all hold together (Bonferroni)."""
        level = 1.0 - (1.0 - CONFIDENCE) / len(self.inside)
        ends = [clopper_pearson(held, self.trials, level) for held in self.inside]
        low, high = np.min(ends, axis=0).tolist()
        return low, high

    @property
    def finds_between(self) -> tuple[float, float]:
        """The 95 % interval of `finds` over simulations, with the truth known."""
        return clopper_pearson(self.found, self.trials)


@dataclass(frozen=True)
class Point:
    """Holds one truth that fits the user's data, and what simulations at it say."""

    at: Mapping[str, float]
    """Its parameters in their own units."""
    claims: Sequence[Claim]

    @property
    def words(self) -> str:
        """Its parameters by name."""
        return ", ".join(f"{name} = {value:.4g}" for name, value in self.at.items())


@dataclass(frozen=True)
class Own:
    """Answers which estimator to take for data like a user's own."""

    trials: int
    points: Sequence[Point]
    """The least minimum first."""
    noise: str
    """The size of the noise, in words."""
    states_prior: bool
    """Whether the user stated what the estimators with a prior are told."""
    left_out: Mapping[str, str]
    """Estimators that do not suit the data, and why."""
    moving: bool = False
    """Whether the data are a log of states that move."""
    further: int = 0
    """Answers that fit, beyond the points, at which nothing was simulated."""


@dataclass(frozen=True)
class _Truth:
    """Holds a point (n,) in the coordinates of the model, with its copies: points of the same
    readings."""

    x: Array
    copies: tuple[Array, ...]


def require_answer(fit: Fit) -> None:
    """Refuses an estimate from which nothing can be simulated: there is none, its fit is rejected,
    or the readings leave it open."""
    ended = f"the estimate ended {fit.status.label}"
    p = fit.white_p
    reasons = {
        "the model does not fit the readings": fit.fits is False,
        ended: not fit.passes,
        f"the readings do not determine {', '.join(fit.undetermined)}": bool(fit.undetermined),
        "there are no more readings than parameters": fit.degrees_of_freedom <= 0,
        f"successive residuals resemble each other (p = {p:.1g}), so that the model or the noise is"
        " wrong": p < FIT_LEVEL,
        "the estimate is on a bound": bool(fit.held_at),
        "the residuals are zero": not fit.chi_square or fit.level == 0.0,
    }
    for reason, holds in reasons.items():
        if holds:
            raise UserError(
                f"{reason}: data sets simulated from it would not be like yours; see `ipe-bench"
                " estimate` with the same words, and mend the model or its start first"
            )


def own(
    question: Question,
    estimators: Mapping[str, Estimator],
    trials: int,
    seed: int = 0,
    progress: Shows = False,
) -> Own:
    """Simulates readings like those of a question, which names one estimator that answers it, and
    lets `estimators` answer them; `progress` shows how far that is.

    Raises:
        UserError: the question has no answer from which readings can be simulated.
    """
    with counting("estimate", 1, progress) as begin:
        fits, examination = question.fitted(begin)
    fit = fits[0]
    require_answer(fit)
    problem = _at_least(fit, examination)
    with_prior = problem
    if problem.prior_deviation is None:
        with_prior = replace(problem, prior_deviation=np.ones(problem.measurement.n))
    left_out = {}
    for label, one in estimators.items():
        why = one.hindrance(with_prior)
        if why:
            left_out[label] = why
    kept = {label: one for label, one in estimators.items() if label not in left_out}
    points = []
    truths = _truths(fit, examination, problem)
    simulated = truths[:MOST_POINTS]
    with counting("simulated data sets", len(simulated) * len(kept), progress) as begin:
        for truth in simulated:
            z = _drawn(fit, problem, truth.x, trials, seed)
            claims = _claims(fit, problem, kept, truth, z, begin)
            values = problem.measurement.physical(truth.x[None])[0].tolist()
            names = [p.name for p in problem.measurement.physical_parameters]
            points.append(Point(dict(zip(names, values, strict=True)), claims))
    more = len(truths) - len(points)
    noise = from_to(problem.R.deviations.tolist(), "{:.3g}".format)
    if len(fit.levels) > 1:
        noise = ", ".join(f"{name} = {value:.3g}" for name, value in fit.levels.items())
    return Own(trials, points, noise, question.has_prior, left_out, further=more)


def _at_least(fit: Fit, examination: Examination | None) -> Problem:
    """Returns the problem of the readings with the level of noise at the least minimum, which the
    estimate may have missed."""
    problem = replace(fit.given.problem, R=fit.assumed.R)
    if examination is None or fit.level is None or fit.estimated is not None:
        return problem
    least = min(examination.minima[0].chi_square, examination.chi_square)
    return scaled(problem, float(np.sqrt(least / fit.degrees_of_freedom)))


def _truths(fit: Fit, examination: Examination | None, problem: Problem) -> list[_Truth]:
    """Lists the minima that fit, the least first and each curve once."""
    model = problem.measurement
    estimate = fit.inner[: model.n]
    places = [estimate]
    if examination is not None:
        minima = [one.inner[: model.n] for one in examination.minima if one.as_good]
        places = [*minima, estimate] if minima else places
    found: list[_Truth] = []
    for x in places:
        same = [i for i, truth in enumerate(found) if _same_curve(problem, truth.x, x)]
        if same:
            # Of copies the last is named, which is the estimate itself.
            found[same[0]] = _Truth(x, (*found[same[0]].copies, x))
        elif x is not estimate or not found:
            found.append(_Truth(x, (x,)))
    return found


def _same_curve(problem: Problem, x: Array, y: Array) -> bool:
    model = problem.measurement
    with np.errstate(all="ignore"):
        h, other = model.simulate(np.stack([x, y]))
        apart = problem.R.whiten(h - model.near(other, h))
    return bool((np.abs(apart) < _SAME_CURVE).all())


def _drawn(fit: Fit, problem: Problem, x: Array, trials: int, seed: int) -> Array:
    """Draws readings (trials, present) at x (n,), with the noise that is estimated or stated."""
    given = fit.given
    streams = numbered(seed, 0, trials, _NOISE)
    if given.noise.estimated:
        h = problem.measurement.simulate(x[None])[0]
        e = np.array([rng.standard_normal(len(h)) for rng in streams])
        return h + problem.R.coloured(e)
    h = given.model.simulate(x[None])[0]
    offset = given.model.offset
    z = np.array([given.noise.corrupt(h, offset, rng) for rng in streams])
    return np.ascontiguousarray(z[:, given.rows])


def _claims(
    fit: Fit,
    problem: Problem,
    estimators: Mapping[str, Estimator],
    truth: _Truth,
    z: Array,
    begin: Callable[[str], Callable[[str], object]],
) -> list[Claim]:
    """Lets each estimator answer readings z (trials, m) of a truth, those with a prior once for
    each that they are told; `begin` is called with the label of each, and what it returns with how
    far that is."""
    runs: list[tuple[str, str, Estimates]] = []
    for label, one in estimators.items():
        tell = begin(label)
        for told, known in _tellings(problem, one).items():
            parts = []
            for first in range(0, len(z), _AT_ONCE):
                tell(f"{first} of {len(z)}")
                parts.append(estimate_safely(one, known, z[first : first + _AT_ONCE]))
            runs.append((label, told, Estimates.join(parts)))
    model = problem.measurement
    curves = [_curves(model, each.x, z) for _, _, each in runs]
    curves.append(_curves(model, _from_truth(problem, truth.x, z), z))
    sums = np.stack([_squares(problem, z - h) for h in curves])
    best = np.stack(curves)[sums.argmin(axis=0), np.arange(len(z))]
    claims = []
    for (label, told, each), h, chi_square in zip(runs, curves, sums, strict=False):
        # Its curve lies closer to the best fit's than noise puts that to the truth's.
        near = _squares(problem, model.near(h, best) - best) <= model.n
        reported = _reported(fit, problem, truth.x, z - h, chi_square)
        claims.append(_claim(label, told, model, each, truth, near, reported))
    return claims


def _reported(fit: Fit, problem: Problem, x: Array, r: Array, chi_square: Array) -> Reported:
    """Finds what `estimate`, which does not know the noise, makes of answers with residuals r
    (trials, m) to readings at the truth x (n,)."""
    still = np.zeros((len(r), problem.measurement.n))
    if fit.estimated is not None:
        return by_levels(fit.estimated, problem, x, r)
    if not fit.given.noise.estimated:
        return Reported(still, still + half_width(CONFIDENCE, None))
    free = fit.degrees_of_freedom
    scale = np.sqrt(chi_square / free)
    # An answer that has no readings has no interval, not an infinite one.
    scale = np.where(np.isfinite(scale), scale, 0.0)
    return Reported(still, half_width(CONFIDENCE, free) * (still + scale[:, None]))


def _tellings(problem: Problem, estimator: Estimator) -> dict[str, Problem]:
    """Returns the problems of an estimator by the prior that it is told, in words."""
    if "prior" not in estimator.needs:
        return {"": problem.without_prior()}
    if problem.prior_deviation is not None:
        return {"your prior": problem}
    ones = np.ones(problem.measurement.n)
    return {
        f"start ± {100 * size:.0f} %": replace(problem, prior_deviation=size * ones)
        for size in SIZES
    }


def _curves(model: Measurement, x: Array, z: Array) -> Array:
    """Computes the readings (trials, m) of answers x (trials, n), near those that were read; NaN
    without an answer."""
    h = np.full(z.shape, np.nan)
    known = np.isfinite(x).all(axis=1)
    with np.errstate(all="ignore"):
        if known.any():
            counting = CountingModel(model, EvaluationCount.zeros(len(z)))
            found = counting.simulate(np.ascontiguousarray(x[known]), np.flatnonzero(known))
            h[known] = model.near(found, z[known])
    return h


def _squares(problem: Problem, r: Array) -> Array:
    """Sums the squares (trials,) of whitened residuals; infinite where they are not finite."""
    with np.errstate(all="ignore"):
        sums = np.sum(problem.R.whiten(r) ** 2, axis=1)
    return np.nan_to_num(sums, nan=np.inf, posinf=np.inf)


def _from_truth(problem: Problem, x: Array, z: Array) -> Array:
    """Finds the least squares (trials, n) next to the truth, in the coordinates of the model."""
    model = problem.measurement
    known = [
        ParameterInfo(p.name, nominal=float(value * p.size))
        for p, value in zip(model.parameters, x, strict=True)
    ]
    there = replace(problem.without_prior(), measurement=ConstrainedModel(model, tuple(known)))
    return estimate_safely(LevenbergMarquardt(), there, z).x


def _claim(
    label: str,
    told: str,
    model: Measurement,
    each: Estimates,
    truth: _Truth,
    near: Array,
    reported: Reported,
) -> Claim:
    """Counts what an estimator found, given what `estimate` would report of its answers."""
    deviation = np.full(each.x.shape, np.nan)
    with np.errstate(all="ignore"):
        if each.covariance is not None:
            deviation = deviations(each.covariance)
        half = deviation * reported.width
        answer = each.x + reported.shift
        ratios = np.stack([np.abs(answer - x) / half for x in truth.copies])
    ratios = np.where(np.isfinite(ratios), ratios, np.inf)
    # An answer at a copy, such as one of another sign, is held against that.
    closest = ratios.max(axis=2).argmin(axis=0)
    ratio = ratios[closest, np.arange(len(half))]
    names = [p.name for p in model.physical_parameters]
    spent = np.median(cost(each.simulations, each.jacobians, model.jacobian_cost))
    seconds = float(np.mean(each.seconds))
    return Claim.of(label, told, near, ratio, names, cost=float(spent), seconds=seconds)
