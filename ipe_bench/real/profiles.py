"""Intervals of parameters: from standard errors, and from the profile likelihood.

A profile interval holds what it promises where the model bends and intervals from standard errors do not (Venzon and
Moolgavkar, Applied Statistics 37, 1988; Bates and Watts, Nonlinear Regression Analysis and Its Applications, 1988,
section 6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtri, fdtri, stdtrit

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import minimize
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.levels import objective_of

CONFIDENCE = 0.95
_FARTHEST = 1e6
"""Half-widths from standard errors beyond which no end is searched for."""
_STRETCHES = 24
"""The most steps outwards."""
_PRECISION = 1e-8
"""The precision of an end, as a share of the half-width."""
_LIMITS = Limits(1e-7, 100)
_LOWER = 1e-6
"""A chi-square that is smaller than at the estimate by more than this is that of a lower minimum."""
_ON_BOUND = 1e-9
"""A value nearer to a bound than this share of the start's distance is on the bound, but for round-off."""


def half_width(level: float, freedom: float | Array | None) -> float | Array:
    """The normal quantile of a two-sided interval; Student's t if the level of the noise is estimated from `freedom`
    degrees of freedom, or (n,) of them."""
    return stdtrit(np.inf if freedom is None else freedom, (1 + level) / 2)


def joint_region(parameters: int, level: float, freedom: float | None) -> float:
    """The squared distance, in standard errors, to the edge of the joint confidence region of some parameters:
    chi-square, or F if the level of the noise is estimated from `freedom` degrees of freedom."""
    if freedom is None:
        return float(chdtri(parameters, 1 - level))
    return float(parameters * fdtri(parameters, freedom, level))


def natural_limits(model: Measurement) -> tuple[Array, Array]:
    """The lower and the upper bounds (n,) of the parameters in their own units; infinite where there are none."""
    ends = model.physical(np.stack([np.full(model.n, -np.inf), np.full(model.n, np.inf)]))
    return ends.min(axis=0), ends.max(axis=0)


def wald_interval(model: Measurement, x: Array, deviation: Array, q: float | Array) -> tuple[Array, Array]:
    """The interval (n,), (n,) of q standard deviations (n,) about the estimate x (n,), in the parameters' own units.

    It is symmetric in x, such as the logarithm of a distance to a bound. If three times q standard errors reach a
    bound, the logarithm bends too much over the interval, which is then symmetric in the parameter and ends at the
    bound.
    """
    with np.errstate(all="ignore"):
        ends = model.physical(np.stack([x - q * deviation, x + q * deviation]))
        value, error = model.physical(x[None])[0], deviation * np.abs(model.physical_slope(x[None])[0])
    lower, upper = natural_limits(model)
    with np.errstate(invalid="ignore"):
        reached = (value - 3 * q * error <= lower) | (value + 3 * q * error >= upper)
        reached &= np.isfinite(lower) | np.isfinite(upper)
    low = np.where(reached, np.maximum(lower, value - q * error), ends.min(axis=0))
    return low, np.where(reached, np.minimum(upper, value + q * error), ends.max(axis=0))


@dataclass(frozen=True)
class Released:
    """A problem in which parameters that are on their bounds may leave them."""

    problem: Problem
    """The problem with those parameters free of bounds."""
    x: Array
    """The minimum (n,) with them on their bounds."""
    P: Array
    """The covariance (n, n) there."""
    places: NDArray[np.intp]
    """Their places among the parameters."""
    inwards: Array
    """The sign that leads inwards, of each."""

    def inside(self, x: Array) -> Mask:
        """Which of the points x (points, n) are within each of these bounds, (points, bounds)."""
        return (x - self.x)[:, self.places] * self.inwards >= 0


def profiles(
    problem: Problem,
    z: Array,
    x: Array,
    P: Array,
    *,
    freedom: float | Array | None = None,
    places: Sequence[int] | None = None,
    signs: Sequence[int] = (-1, 1),
    released: Released | None = None,
) -> tuple[Array, Array]:
    """The profile intervals (places,), (places,) of the parameters `places`, or of all, in their own units, about the
    least-squares estimate x (n,) of covariance P (n, n) from readings z (m,), all present.

    An end is infinite if the readings set no limit; both are NaN if the search finds a better fit than the estimate.
    `freedom` (n,) stands for several levels of the noise among the parameters. `signs` are the sides on which an end is
    searched for; the other end is infinite. Parameters that are `released` may leave their bounds inwards.

    If the estimate of a parameter is on a bound, one end is the bound. The rise of chi-square is compared with the
    same quantile as inside of bounds: if the true value is beyond, the estimate is only nearer to it, so that the
    interval holds it at least as often as it says.
    """
    model, q = problem.measurement, np.broadcast_to(half_width(CONFIDENCE, freedom), len(x))
    behind = freedom if isinstance(freedom, np.ndarray) else np.full(len(x), np.inf)
    objective = objective_of(problem, z[None])
    least = float(objective.cost(x[None], objective.residual(x[None]))[0])
    start, limits, found = model.physical(model.nominal[None])[0], natural_limits(model), []
    for k in range(len(x)) if places is None else places:
        sides = {s: _Side(problem, z, x, P, k, s, q[k], behind[k], least, released) for s in signs}
        ends = np.repeat(x[None], 2, axis=0)
        ends[:, k] += [s * (sides[s].end() if s in sides else np.inf) for s in (-1, 1)]
        with np.errstate(invalid="ignore"):
            values = np.sort(model.physical(ends)[:, k])
        for bound in (limits[0][k], limits[1][k]):
            if np.isfinite(bound):
                values[np.abs(values - bound) <= _ON_BOUND * abs(start[k] - bound)] = bound
        found.append(np.full(2, np.nan) if any(one.lower for one in sides.values()) else values)
    low, high = np.array(found).reshape(-1, 2).T
    return low, high


@dataclass
class _Side:
    """One side of the profile of a parameter."""

    problem: Problem
    z: Array
    x: Array
    P: Array
    place: int
    sign: int
    q: float
    """The rise of root chi-square at the end."""
    freedom: float
    """Degrees of freedom f of levels that are among the other parameters: chi-square then rises by f log(1 + t^2 / f)
    where a linear model would give Student's t; infinite if the levels stay as they are."""
    least: float
    """The sum of squares at the estimate."""
    released: Released | None
    lower: bool = False
    """Whether a better fit than the estimate was found."""

    def __post_init__(self) -> None:
        # By distance from the estimate: the rise of root chi-square, and the parameters.
        self.seen: dict[float, tuple[float, Array]] = {0.0: (0.0, self.x)}

    def end(self) -> float:
        """The distance from the estimate to the end of the interval; infinite if there is none."""
        half = self.q * float(np.sqrt(self.P[self.place, self.place]))
        near, far = 0.0, half
        for _ in range(_STRETCHES):
            if (risen := self.rise(far)) >= self.q:
                end = brentq(lambda distance: self.rise(distance) - self.q, near, far, xtol=_PRECISION * half)
                return float(end)  # type: ignore[arg-type]
            near, far = far, far * float(np.clip(1.05 * self.q / max(risen, 1e-3), 1.1, 2.0))
            if self.lower or far > _FARTHEST * half:
                break
        return np.inf

    def rise(self, distance: float) -> float:
        """The rise of root chi-square, up to twice q, the others beginning at the nearest point that is known, moved
        along the line on which they would follow in a linear model."""
        if distance not in self.seen:
            usable = [known for known, (zeta, _) in self.seen.items() if zeta < 2.0 * self.q]
            nearest = min(usable, key=lambda known: abs(known - distance))
            at = self.x[self.place] + self.sign * distance
            point, total = _fit_others(self.problem, self.z, self.P, self.place, at, self.seen[nearest][1])
            if (free := self.released) is not None:
                place = int(np.setdiff1d(np.arange(len(free.x)), free.places)[self.place])
                freed, less = _fit_others(free.problem, self.z, free.P, place, at, free.x)
                total = np.fmin(total, less) if free.inside(freed[None]).all() else total
            change = total - self.least
            if np.isfinite(self.freedom):
                with np.errstate(over="ignore"):
                    change = self.freedom * np.expm1(change / self.freedom)
            self.lower |= change < -_LOWER * max(1.0, self.least)
            zeta = np.fmin(np.sqrt(np.maximum(change, 0.0)), 2.0 * self.q)
            self.seen[distance] = float(zeta), point
        return self.seen[distance][0]


@dataclass(frozen=True, kw_only=True)
class _Pinned(CountingModel):
    """A model in which one parameter has a fixed value, and x are the others."""

    place: int
    value: float

    def simulate(self, x: Array, rows: NDArray[np.intp]) -> Array:
        return super().simulate(self.whole(x), rows)

    def jacobian(self, x: Array, rows: NDArray[np.intp], *, coarse: Mask | bool = False) -> Array:
        return np.delete(super().jacobian(self.whole(x), rows, coarse=coarse), self.place, axis=2)

    def whole(self, x: Array) -> Array:
        return np.insert(x, self.place, self.value, axis=1)


def _fit_others(problem: Problem, z: Array, P: Array, place: int, at: float, near: Array) -> tuple[Array, float]:
    """The minimum (n,) with one parameter at a value, and the sum of squares there, from where a linear model of
    covariance P (n, n) would lead from a point `near` (n,)."""
    model = _Pinned(problem.measurement, EvaluationCount.zeros(1), place=place, value=at)
    objective = objective_of(problem, z[None], model)
    x = np.delete(near + P[:, place] / P[place, place] * (at - near[place]), place)[None]
    with np.errstate(all="ignore"):
        if x.size:
            x = minimize(objective, LevenbergMarquardtMethod(1e-3), x, _LIMITS).x
        total = objective.cost(x, objective.residual(x))
    return model.whole(x)[0], float(total[0])
