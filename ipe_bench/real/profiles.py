"""Profile-likelihood intervals: what the readings say of one parameter when all others adapt to it.

Where the model bends, these hold what they promise and intervals from standard errors do not (Venzon and Moolgavkar,
Applied Statistics 37, 1988; Bates and Watts, Nonlinear Regression Analysis and Its Applications, 1988, section 6.1).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri, stdtrit

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import minimize
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.levels import objective_of

CONFIDENCE = 0.95
_FIRST = (0.5, 1.0, 1.5)
"""Where a profile is looked at first on either side, in multiples of the half-width from standard errors."""
_ROUNDS = 24
"""Further looks at each end."""
_STRETCH = 2.0
"""How many times farther a look may be than the one before."""
_PRECISION = 1e-4
"""The precision of an end, as a share of the half-width."""
_TOLERANCE = 1e-7
_MOST_STEPS = 100
_LOWER = 1e-6
"""A chi-square that is smaller than at the estimate by more than this is that of a lower minimum."""
_ON_BOUND = 1e-9
"""A value nearer to a bound than this share of the start's distance is on the bound: it was reached by round-off."""


@dataclass(frozen=True)
class Profile:
    """One parameter's profile: where it was looked at, and the interval."""

    values: Array
    """Values (points,) of the parameter, ascending, in its own unit; the estimate among them."""
    zeta: Array
    """The signed root of the rise of chi-square (points,): a straight line through zero where the model is linear."""
    low: float
    """The lower end of the interval in the parameter's unit; infinite where the readings set no limit."""
    high: float
    """The upper end, likewise."""
    wald: tuple[float, float]
    """The interval from the standard error, of the same confidence."""
    lower_minimum: bool
    """Whether the search came upon a better fit than the estimate: then the interval is not one."""

    @property
    def bent(self) -> bool:
        """Whether an end differs by more than a tenth of the half-width from that of the standard error."""
        half = (self.wald[1] - self.wald[0]) / 2
        ends = abs(self.low - self.wald[0]), abs(self.high - self.wald[1])
        return not max(ends) <= 0.1 * half


def half_width(level: float, freedom: float | Array | None) -> float | Array:
    """The quantile that a rise of root chi-square is compared with: normal, or Student's t where the level of the noise
    is estimated from `freedom` degrees of freedom, or (n,) of them."""
    return stdtrit(np.inf if freedom is None else freedom, (1 + level) / 2)


def joint_region(parameters: int, level: float, freedom: float | None) -> float:
    """The squared distance, in standard errors, to the edge of a joint confidence region of so many parameters:
    chi-square, or F where the level of the noise is estimated from `freedom` degrees of freedom."""
    if freedom is None:
        return float(chdtri(parameters, 1 - level))
    return float(parameters * fdtri(parameters, freedom, level))


def natural_limits(model: Measurement) -> tuple[Array, Array]:
    """The lower and the upper bounds (n,) of the parameters in their own units; infinite where there are none."""
    ends = model.physical(np.stack([np.full(model.n, -np.inf), np.full(model.n, np.inf)]))
    return ends.min(axis=0), ends.max(axis=0)


def wald_interval(model: Measurement, x: Array, deviation: Array, q: float | Array) -> tuple[Array, Array]:
    """The interval (n,), (n,) of q standard deviations (n,) about the estimate x (n,), in the parameters' own units.

    It is symmetric in x, the logarithm of a distance to a bound, say. If three times q standard errors reach a bound,
    the logarithm bends too much over the interval, which is then symmetric in the parameter and ends at the bound.
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


def profiles(
    problem: Problem,
    z: Array,
    x: Array,
    P: Array,
    *,
    levels: Array | None = None,
    freedom: float | Array | None = None,
    places: Sequence[int] | None = None,
    signs: Sequence[int] = (-1, 1),
    released: Released | None = None,
) -> list[list[Profile]]:
    """For each set of readings z (sets, m), all present, the profiles of the parameters `places`, or of all, about the
    least-squares estimates x (sets, n) of covariances P (sets, n, n).

    `freedom` (n,) stands for several levels of the noise, which are among the parameters. `levels` (sets,): what each
    set has found R^1/2 to be multiplied by, and P has been multiplied by the square of. `signs`: on which sides an end
    is looked for; the other is infinite. `released`: parameters held on bounds, which may leave them inwards where that
    fits better.

    Of a parameter whose estimate is on a bound the one end is the bound. The rise of chi-square is compared with the
    same quantile as inside of bounds: beyond the bound the true value may be anywhere, and an estimate on the bound is
    only nearer to it, so that the interval holds it at least as often as it says.
    """
    objective = objective_of(problem, z)
    least = objective.cost(x, objective.residual(x))
    q = np.broadcast_to(half_width(CONFIDENCE, freedom), x.shape[1])
    behind = freedom if isinstance(freedom, np.ndarray) else np.full(x.shape[1], np.inf)
    levels = np.ones(len(x)) if levels is None else levels
    where = range(x.shape[1]) if places is None else places
    searches = [
        [
            _Search(problem.measurement, z[k], x[k], P[k], float(levels[k]), float(least[k]), j, q[j], behind[j])
            for j in where
        ]
        for k in range(len(x))
    ]
    every = [one for row in searches for one in row]
    asked = [(one, one.centre + s * f * one.q * one.deviation) for one in every for s in signs for f in _FIRST]
    for _ in range(_ROUNDS + 1):
        _look(problem, asked, released)
        asked = [(one, at) for one in every for sign in signs if (at := one.next(sign)) is not None]
        if not asked:
            break
    return [[one.profile() for one in row] for row in searches]


@dataclass
class _Search:
    """What has been seen of the profile of one parameter of one set of readings."""

    model: Measurement
    z: Array
    x: Array
    P: Array
    level: float
    least: float
    """The sum of squares at the estimate."""
    place: int
    q: float
    """The rise of root chi-square at the ends."""
    freedom: float
    """Degrees of freedom f of levels that are among the other parameters: chi-square then rises by f log(1 + t^2 / f)
    where a linear model would give Student's t; infinite where levels stay as they are."""

    def __post_init__(self) -> None:
        self.centre, self.deviation = float(self.x[self.place]), float(np.sqrt(self.P[self.place, self.place]))
        # By value of the parameter: the signed root of the rise, and the other parameters with it.
        self.seen: dict[float, tuple[float, Array]] = {self.centre: (0.0, self.x)}
        self.open: set[int] = set()
        self.lower = False

    def note(self, at: float, total: float, point: Array) -> None:
        """Takes in the sum of squares at a value; of two the smaller counts."""
        change = (total - self.least) / self.level**2
        if np.isfinite(self.freedom):
            with np.errstate(over="ignore"):
                change = self.freedom * np.expm1(change / self.freedom)
        if at in self.seen and not change < self.seen[at][0] ** 2:
            return
        self.lower |= change < -_LOWER * max(1.0, self.least / self.level**2)
        zeta = np.sqrt(max(change, 0.0)) if np.isfinite(change) else np.inf
        self.seen[at] = (float(np.sign(at - self.centre) * zeta), point)

    def start(self, at: float) -> Array:
        """Where to begin for that value: the nearest point seen, moved along the line on which the others would follow
        in a linear model."""
        nearest = min((v for v, (zeta, _) in self.seen.items() if np.isfinite(zeta)), key=lambda v: abs(v - at))
        start = self.seen[nearest][1] + self.P[:, self.place] / self.P[self.place, self.place] * (at - nearest)
        start[self.place] = at
        return start

    def crossing(self, sign: int) -> tuple[tuple[float, float], tuple[float, float] | None]:
        """On one side, as (distance, abs zeta): the first neighbours between which the profile rises over q; or the
        farthest look and None, where it has not risen yet."""
        found = [(v - self.centre, abs(zeta)) for v, (zeta, _) in self.seen.items() if sign * (v - self.centre) >= 0]
        points = sorted((abs(distance), zeta) for distance, zeta in found)
        return next(((a, b) for a, b in itertools.pairwise(points) if a[1] < self.q <= b[1]), (points[-1], None))

    def end(self, sign: int) -> float:
        """The distance to the end of the interval, by linear interpolation."""
        (near, below), beyond = self.crossing(sign)
        if beyond is None:
            return np.inf
        far, above = beyond
        return far if above == below else near + (far - near) * (self.q - below) / (above - below)

    def next(self, sign: int) -> float | None:
        """Where to look next for an end; None where it is known, or there is none."""
        if self.lower or sign in self.open:
            return None
        (near, below), beyond = self.crossing(sign)
        if beyond is None:
            if not np.isfinite(below) or near > 1e6 * self.q * self.deviation:
                self.open.add(sign)
                return None
            return self.centre + sign * near * min(_STRETCH, max(1.1, 1.05 * self.q / max(below, 1e-3)))
        far, above = beyond
        distance = self.end(sign) if np.isfinite(above) else (near + far) / 2
        close = min(self.q - below, above - self.q) <= _PRECISION * self.q
        if close or far - near <= _PRECISION * self.q * self.deviation * 1e-3:
            return None
        # Interpolation alone may creep up to the end from one side.
        return self.centre + sign * float(np.clip(distance, near + 0.05 * (far - near), far - 0.05 * (far - near)))

    def profile(self) -> Profile:
        inner = np.array(sorted(self.seen))
        zeta = np.array([self.seen[v][0] for v in inner])
        with np.errstate(invalid="ignore"):
            low, high = sorted(self.physical(np.array([self.centre - self.end(-1), self.centre + self.end(1)])))
            values = self.physical(inner)
        low_wald, high_wald = wald_interval(self.model, self.x, np.sqrt(np.diag(self.P)), self.q)
        wald = float(low_wald[self.place]), float(high_wald[self.place])
        order = np.argsort(values)
        zeta = zeta if values[-1] >= values[0] else -zeta
        return Profile(values[order], zeta[order], float(low), float(high), wald, self.lower)

    def physical(self, values: Array) -> Array:
        """Values of the parameter in its own unit, on a bound where they are as near as round-off."""
        points = np.repeat(self.x[None], len(values), axis=0)
        points[:, self.place] = values
        found = self.model.physical(points)[:, self.place]
        start = self.model.physical(self.model.nominal[None])[0, self.place]
        for limits in natural_limits(self.model):
            bound = limits[self.place]
            if np.isfinite(bound):
                found = np.where(np.abs(found - bound) <= _ON_BOUND * abs(start - bound), bound, found)
        return found


def _look(problem: Problem, asked: Sequence[tuple[_Search, float]], released: Released | None) -> None:
    """Minimises over the other parameters at every place that is asked for, all in one batch."""
    places, values = np.array([one.place for one, _ in asked]), np.array([at for _, at in asked])
    z, begin = np.stack([one.z for one, _ in asked]), np.stack([one.start(at) for one, at in asked])
    points, sums = _fit_others(problem, places, values, z, begin)
    for (one, at), total, point in zip(asked, sums.tolist(), points, strict=True):
        one.note(at, total, point)
    if released is None:
        return
    places = np.setdiff1d(np.arange(len(released.x)), released.places)[places]
    moved = (values - released.x[places]) / released.P[places, places]
    freed, sums = _fit_others(
        released.problem, places, values, z, released.x + released.P[:, places].T * moved[:, None]
    )
    inside = np.asarray(released.inside(freed).all(axis=1)).tolist()
    for (one, at), total, within, point in zip(asked, sums.tolist(), inside, points, strict=True):
        if within and np.isfinite(total):
            one.note(at, total, point)


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
    """Which of the parameters they are."""
    inwards: Array
    """The sign that leads inwards, of each."""

    def inside(self, x: Array) -> Mask:
        """Which of the points x (points, n) are within all of these bounds, (points, bounds)."""
        return (x - self.x)[:, self.places] * self.inwards >= 0


@dataclass(frozen=True, kw_only=True)
class _Pinned(CountingModel):
    """A model in which one parameter of each trial has a value of its own, and x are the others."""

    places: NDArray[np.intp]
    """Which parameter, for each trial of the tally."""
    values: Array
    """Its value."""

    def simulate(self, x: Array, rows: NDArray[np.intp]) -> Array:
        return super().simulate(self.whole(x, rows), rows)

    def jacobian(self, x: Array, rows: NDArray[np.intp], *, coarse: Mask | bool = False) -> Array:
        J = super().jacobian(self.whole(x, rows), rows, coarse=coarse)
        return np.take_along_axis(J, self._others(rows)[:, None, :], axis=2)

    def _others(self, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        k = np.arange(self.measurement.n - 1)
        return k + (k >= self.places[rows, None])

    def whole(self, x: Array, rows: NDArray[np.intp]) -> Array:
        """The full parameter vectors (trials, n)."""
        full = np.empty((len(x), self.measurement.n))
        np.put_along_axis(full, self._others(rows), x, axis=1)
        full[np.arange(len(x)), self.places[rows]] = self.values[rows]
        return full


def _fit_others(
    problem: Problem, places: NDArray[np.intp], values: Array, z: Array, begin: Array
) -> tuple[Array, Array]:
    """The minima (asked, n) with the parameters `places` at `values` (asked,), and the sums of squares there (asked,),
    for readings z (asked, m), from `begin` (asked, n)."""
    rows = np.arange(len(values))
    model = _Pinned(problem.measurement, EvaluationCount.zeros(len(values)), places=places, values=values)
    objective = objective_of(problem, z, model)
    x = np.stack([np.delete(start, place) for start, place in zip(begin, places, strict=True)])
    with np.errstate(all="ignore"):
        if x.shape[1]:
            x = minimize(objective, LevenbergMarquardtMethod(1e-3), x, Limits(_TOLERANCE, _MOST_STEPS)).x
        sums = objective.cost(x, objective.residual(x))
    return model.whole(x, rows), sums
