"""Computes intervals of parameters: from standard errors, and from the profile likelihood.

A profile interval holds what it promises where the model bends and intervals from standard errors
do not (Venzon and Moolgavkar, Applied Statistics 37, 1988; Bates and Watts, Nonlinear Regression
Analysis and Its Applications, 1988, section 6.1).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri, stdtrit

from ipe_bench.basics.linalg import Array, Mask, repeated
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import minimize
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.levels import objective_of

CONFIDENCE = 0.95
_FARTHEST = 1e6
"""Half-widths from standard errors beyond which no end is searched for."""
_DECADES = 30.0
"""Decades of a bounded parameter's distance to its bound beyond which no end is searched for."""
_STRETCHES = 27
"""The most steps outwards."""
_FLAT = 0.01
"""The share of what is left to the limit by which a profile rises at most while the distance
doubles, twice, where it is followed no further: a hundred doublings would not end it."""
_STRAIGHT = 0.02
"""The share by which a rise differs at most from that of a linear model where steps may be
large."""
_EXACT = 1e-6
"""The share by which a rise that a linear model tells differs at most from what is found."""
_PRECISION = 1e-8
"""The precision of an end, as a share of its distance and of the half-width."""
_JUMP = 0.01
"""A rise just before an end that is smaller than there by more than this share has jumped."""
_LOWER_VALLEY = 0.004
"""A rise at an end that is smaller than it should be by more than this share is that of another
valley: chi-square has then risen by less than 0.99 of its limit."""
_STEP = 1e-4
"""The share of the distance to an end within which a rise does not fall that far, unless minima
were lost there."""
_NEAR_ZERO = 1e-6
"""The share of an estimate within which of 0 a jump of its profile is at 0."""
_LIMITS = Limits(1e-7, 100)
_LOWER = 1e-6
"""A chi-square that is smaller than at the estimate by more than this is that of a lower
minimum."""
_ON_BOUND = 1e-9
"""A value nearer to a bound than this share of it is on the bound, but for round-off."""


def half_width(confidence: float, freedom: float | Array | None) -> float | Array:
    """Returns the normal quantile of a two-sided interval; Student's t if the level of the noise is
    estimated from `freedom` degrees of freedom, or (n,) of them."""
    return stdtrit(np.inf if freedom is None else freedom, (1 + confidence) / 2)


def joint_region(parameters: int, confidence: float, freedom: float | None) -> float:
    """Computes the squared distance, in standard errors, to the edge of the joint confidence region
    of some parameters: chi-square, or F if the level of the noise is estimated from `freedom`
    degrees of freedom."""
    if freedom is None:
        return float(chdtri(parameters, 1 - confidence))
    return float(parameters * fdtri(parameters, freedom, confidence))


def natural_limits(model: Measurement) -> tuple[Array, Array]:
    """Returns the lower and upper bounds (n,) of the parameters in their own units; infinite if
    there are none."""
    infinite = np.full(model.n, np.inf)
    ends = model.physical(np.stack([-infinite, infinite]))
    return ends.min(axis=0), ends.max(axis=0)


def linear(model: Measurement) -> bool:
    """Tells whether the readings are known to be a linear function of parameters without bounds, so
    that there is one minimum."""
    bounded = np.isfinite(natural_limits(model)).any()
    return model.linear and not bounded and not len(model.periods)


def decades(model: Measurement, x: Array) -> Array:
    """Returns how far (n,) parameters at x (n,) move by a factor of 10 in their distance to a
    bound; infinite if they have none, or two."""
    lower, upper = natural_limits(model)
    bound = np.where(np.isfinite(lower), lower, upper)
    value = model.physical(x[None])[0]
    slope = model.physical_slope(x[None])[0]
    with np.errstate(all="ignore"):
        decade = np.log(10.0) * np.abs((value - bound) / slope)
    return np.where(np.isfinite(lower) == np.isfinite(upper), np.inf, decade)


def wald_interval(
    model: Measurement, x: Array, deviation: Array, q: float | Array
) -> tuple[Array, Array]:
    """Computes the interval (n,), (n,) of q standard deviations (n,) about x (n,), in the
    parameters' own units.

    It is symmetric in x, such as the logarithm of a distance to a bound. If three times q standard
    errors reach a bound, the logarithm bends too much over the interval, which is then symmetric in
    the parameter and ends at the bound.
    """
    reach = q * deviation
    with np.errstate(all="ignore"):
        ends = model.physical(np.stack([x - reach, x + reach]))
        value = model.physical(x[None])[0]
        error = deviation * np.abs(model.physical_slope(x[None])[0])
    lower, upper = natural_limits(model)
    with np.errstate(invalid="ignore"):
        far = 3 * q * error
        reached = (value - far <= lower) | (value + far >= upper)
        reached &= np.isfinite(lower) | np.isfinite(upper)
    low = np.where(reached, np.maximum(lower, value - q * error), ends.min(axis=0))
    high = np.where(reached, np.minimum(upper, value + q * error), ends.max(axis=0))
    return low, high


@dataclass(frozen=True)
class Released:
    """Holds a problem in which parameters that are on their bounds may leave them."""

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
        """Tells which of the points x (points, n) are within each of these bounds, (points,
        bounds)."""
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
    """Computes the profile intervals (places,), (places,) of the parameters `places`, or of all, in
    their own units, about the least-squares estimate x (n,) of covariance P (n, n) from readings z
    (m,), all present.

    An end is infinite if the readings set no limit, and NaN if no minimum is found on the way to
    it; both are NaN if the search finds a better fit than the estimate. `freedom` (n,) stands for
    several levels of the noise among the parameters. `signs` are the sides on which an end is
    searched for; the other end is infinite. Parameters that are `released` may leave their bounds
    inwards.

    If the estimate of a parameter is on a bound, one end is the bound. The rise of chi-square is
    compared with the same quantile as inside of bounds: if the true value is beyond, the estimate
    is only nearer to it, so that the interval holds it at least as often as it says.
    """
    model = problem.measurement
    q = np.broadcast_to(half_width(CONFIDENCE, freedom), len(x))
    behind = np.full(len(x), np.inf)
    if isinstance(freedom, np.ndarray):
        behind = freedom
    objective = objective_of(problem, z[None])
    least = float(objective.cost(x[None], objective.residual(x[None]))[0])
    slope = model.physical_slope(x[None])[0]
    limits = natural_limits(model)
    sought = range(len(x)) if places is None else places
    sides = {
        (k, sign): _Side(
            problem, z, x, P, k, sign, float(q[k]), float(behind[k]), least, objective, released
        )
        for k in sought
        for sign in signs
    }
    for side in sides.values():
        side.follow()
    for (k, _), side in sides.items():
        side.follow_from([other for (place, _), other in sides.items() if place != k])
    found = []
    for k in sought:
        ends = repeated(x, 2)
        low, high = (sides[k, sign].end if sign in signs else np.inf for sign in (-1, 1))
        if len(signs) == 2 and np.isinf([limits[0][k], limits[1][k]]).all():
            below = sides[k, -1]
            above = sides[k, 1]
            if np.isinf(low) and not np.isinf(high) and above.continues(below):
                high = np.inf
            elif np.isinf(high) and not np.isinf(low) and below.continues(above):
                low = np.inf
        ends[:, k] += [-low, high]
        if any(sides[k, sign].beaten for sign in signs):
            ends[:, k] = np.nan
        with np.errstate(invalid="ignore"):
            values = model.physical(ends)[:, k]
        # A negative unit turns the order.
        values = values if slope[k] > 0 else values[::-1]
        for bound in (limits[0][k], limits[1][k]):
            if np.isfinite(bound):
                values[np.abs(values - bound) <= _ON_BOUND * abs(bound)] = bound
        found.append(values)
    low, high = np.array(found).reshape(-1, 2).T
    return low, high


class _BetterFit(Exception):
    """Signals that the search has found a better fit than the estimate."""


@dataclass
class _Side:
    """Follows one side of the profile of the parameter of a place."""

    problem: Problem
    z: Array
    x: Array
    P: Array
    place: int
    sign: int
    q: float
    """The rise of root chi-square at the end."""
    behind: float
    """The degrees of freedom of levels of the noise among the parameters; infinite if there are
    none."""
    least: float
    objective: Objective
    released: Released | None

    def __post_init__(self) -> None:
        self.seen: dict[float, tuple[float, Array]] = {0.0: (0.0, self.x)}
        """The rise up to twice q, and the parameters, by distance from the estimate."""
        self.end = np.nan
        """The distance to the end; infinite if there is none, NaN if minima cannot be followed to
        it."""
        self.beaten = False
        """Whether a better fit than the estimate was met."""

    def follow(self) -> None:
        """Follows the profile from the estimate to its end."""
        half = self._half
        with self._watched():
            straight = self._straight_to(half)
            self.end = half if straight else self._outwards(0.0, 0.0, half / 8)

    def follow_from(self, others: Sequence[_Side]) -> None:
        """Follows the profile on from its end if the minima of the other parameters' profiles lead
        to a lower valley there."""
        alone = not others or linear(self.problem.measurement)
        if alone or self.beaten or not np.isfinite(self.end):
            return
        far = self.end
        with self._watched():
            risen = self.rise(far, further=np.array([one.nearest(self, far) for one in others]))
            if risen < (1 - _LOWER_VALLEY) * self.q:
                self.seen = {far: self.seen[far]}
                self.end = self._outwards(far, risen, 1.1 * far)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except _BetterFit:
            self.beaten = True

    @property
    def _decade(self) -> float:
        return float(decades(self.problem.measurement, self.x)[self.place])

    @property
    def _half(self) -> float:
        """The half-width by the standard error."""
        half = self.q * float(np.sqrt(self.P[self.place, self.place]))
        # A logarithm of which nothing is known may have any standard error.
        return min(half, 8 * self._decade)

    def nearest(self, other: _Side, distance: float) -> Array:
        """Returns the point of this profile that is nearest to a distance along the other one."""
        at = other.x[other.place] + other.sign * distance
        points = [point for _, point in self.seen.values()]
        return min(points, key=lambda point: abs(point[other.place] - at))

    def _outwards(self, near: float, before: float, far: float) -> float:
        """Finds the distance to the end by steps from a distance `far` on; `near` and `before` are
        the distance and the rise that precede it."""
        half = self._half
        decade = self._decade
        flat = 0
        for _ in range(_STRETCHES):
            if far > _DECADES * decade:
                break
            risen = self.rise(far)
            if risen >= self.q:
                far = self._crossing(near, far, half)
                risen = self.rise(far, further=self._around(far))
                if risen >= (1 - _LOWER_VALLEY) * self.q:
                    if self.rise((1 - _STEP) * far) >= (1 - _JUMP) * self.q:
                        return far
                    # As a factor of the model goes to 0, the others may make up for it to the last.
                    zero = float(-self.sign * self.x[self.place])
                    return zero if abs(far - zero) <= _NEAR_ZERO * zero else np.nan
                # Another valley is lower here: the search goes on along that.
                self.seen = {far: self.seen[far]}
            doubled = near >= half and far >= 1.99 * near
            flat = flat + 1 if doubled and abs(risen - before) < _FLAT * (self.q - risen) else 0
            if flat == 2:
                break
            # Small steps where the profile bends, since it may rise beyond q and fall again within
            # a large one.
            straight = abs(risen * half / (far * self.q) - 1) < _STRAIGHT
            # A profile that is straight from the point before meets q there, and 5 % on.
            slope = max((risen - before) / (far - near), 1e-3 / far)
            ahead = (1.05 * self.q - risen) / slope
            stretch = np.clip(1.0 + ahead / far, 1.1, 9.0 if straight else 2.0)
            near = far
            before = risen
            far *= float(stretch)
            if far > _FARTHEST * half:
                break
        return np.inf

    def _straight_to(self, half: float) -> bool:
        """Tells whether the rise is known to be the distance in standard errors, as it is from the
        minimum of a linear model."""
        if not linear(self.problem.measurement) or not np.isfinite(half):
            return False
        return abs(self.rise(half) / self.q - 1) < _EXACT

    def _crossing(self, near: float, far: float, half: float) -> float:
        """Finds the distance between `near` and `far` at which the rise is q, to a share of itself
        and of the half-width."""
        # By the Illinois method (Dowell and Jarratt 1971): scipy.optimize takes .08 s to load.
        low = self.rise(near) - self.q
        high = self.rise(far) - self.q
        turns = 0
        doublings = 0
        least = float(np.spacing(abs(self.x[self.place])))
        while True:
            # Of a standard error that is no size, the half-width is none either.
            precision = max(_PRECISION * min(half, far), least)
            if far - near <= precision:
                return far
            share = high / (high - low) if high > low else 0.5
            met = far - share * (far - near)
            # Beside an end, a step beyond the crossing closes the interval.
            beside = min(precision * 2.0 ** (doublings - 1), (far - near) / 2)
            at = float(np.clip(met, near + beside, far - beside))
            here = self.rise(at) - self.q
            # The rise may be q, but for round-off, over millions of such steps.
            doublings = doublings + 1 if here == 0 else 0
            if here < 0:
                near, low = at, here
                high /= 2 if turns < 0 else 1
                turns = -1
            else:
                far, high = at, here
                low /= 2 if turns > 0 else 1
                turns = 1

    def rise(self, distance: float, *, further: Array | None = None) -> float:
        """Computes the rise of root chi-square at a distance; that of the least minimum found from
        the profile's nearest points and from `further` starts (starts, n), where another valley may
        be lower."""
        if distance in self.seen and further is None:
            return self.seen[distance][0]
        at = float(self.x[self.place] + self.sign * distance)
        starts = self._starts(distance, at)
        if further is not None:
            starts = np.vstack([starts, further])
        point, total = _least_at(self.problem, self.z, self.place, at, starts, self.released)
        risen = self._risen(total)
        self.seen[distance] = risen, point
        return risen

    def _risen(self, total: float) -> float:
        """Computes the rise of root chi-square to a sum of squares, at most twice q."""
        change = total - self.least
        if np.isfinite(self.behind):
            # Levels that are among the other parameters, of f degrees of freedom, raise chi-square
            # by f log(1 + t^2 / f) where a linear model would give Student's t.
            with np.errstate(over="ignore"):
                change = self.behind * np.expm1(change / self.behind)
        if change < -_LOWER * max(1.0, self.least):
            raise _BetterFit
        # Where the model has no value, it has risen.
        return float(np.fmin(np.sqrt(np.maximum(change, 0.0)), 2.0 * self.q))

    def continues(self, other: _Side) -> bool:
        """Tells whether the profile of the other side, which has no end, goes on here behind
        infinity, as that of V in V x / (K + x)."""
        far = max(other.seen)
        start = 2.0 * self.x - other.seen[far][1]
        at = float(self.x[self.place] + self.sign * far)
        _, total = _least_at(self.problem, self.z, self.place, at, start[None], self.released)
        return self._risen(total) < self.q

    def _starts(self, distance: float, at: float) -> Array:
        """Returns the nearest points of the profile, of one side or of both, and where the nearest
        leads to."""
        usable = [d for d, (risen, _) in self.seen.items() if risen < 2.0 * self.q]
        nearest, *others = sorted(usable, key=lambda d: (abs(d - distance), d))
        beyond = [d for d in others if (d - distance) * (nearest - distance) < 0]
        points = [self.seen[d][1] for d in (nearest, *beyond[:1])]
        return np.vstack([_ahead(self.objective, points[0], self.place, at), *points])

    def _around(self, distance: float) -> Array:
        """Returns starts (starts, n) two deviations of the others to both sides of a linear model's
        prediction from the estimate, along each axis of their covariance."""
        P = self.P
        place = self.place
        at = float(self.x[place] + self.sign * distance)
        gain = P[:, place] / P[place, place]
        # The covariance of the others if this one is known.
        left = P - np.outer(gain, P[place])
        sizes, axes = np.linalg.eigh(left)
        steps = 2.0 * np.sqrt(np.maximum(sizes, 0.0))[:, None] * axes.T
        return _along(self.x, P, place, at) + np.vstack([steps, -steps])


@dataclass(frozen=True, kw_only=True)
class _Pinned(CountingModel):
    """Fixes one parameter of a model; x are the others."""

    place: int
    value: float

    def simulate(self, x: Array, rows: NDArray[np.intp]) -> Array:
        return super().simulate(self.whole(x), rows)

    def jacobian(self, x: Array, rows: NDArray[np.intp], *, coarse: Mask | bool = False) -> Array:
        J = super().jacobian(self.whole(x), rows, coarse=coarse)
        return np.delete(J, self.place, axis=2)

    def whole(self, x: Array) -> Array:
        return np.insert(x, self.place, self.value, axis=1)


def _along(x: Array, P: Array, place: int, at: float) -> Array:
    """Follows a linear model of covariance P (n, n) from its minimum x (n,) to a value of the
    parameter of a place."""
    gain = P[:, place] / P[place, place]
    return x + gain * (at - x[place])


def _ahead(objective: Objective, near: Array, place: int, at: float) -> Array:
    """Follows the profile from one of its points `near` (n,) to a value of the parameter of a
    place, if the model is straight on the way."""
    with np.errstate(all="ignore"):
        J = objective.jacobian(near[None])[0]
    if not np.isfinite(J).all():
        return near
    # The others make up for what the one changes, by least squares.
    others = np.delete(J, place, axis=1)
    gain = np.linalg.lstsq(others, J[:, place], rcond=None)[0]
    step = np.full(len(near), at - near[place])
    step[np.arange(len(near)) != place] *= -gain
    return near + step


def _least_at(
    problem: Problem, z: Array, place: int, at: float, starts: Array, released: Released | None
) -> tuple[Array, float]:
    """Finds the least of the minima (n,) with one parameter at a value from `starts` (starts, n),
    and the sum of squares there; that is smaller if parameters that are released fit better inside
    of their bounds, and NaN where the model has no value."""
    tally = EvaluationCount.zeros(len(starts))
    model = _Pinned(problem.measurement, tally, place=place, value=at)
    readings = repeated(z, len(starts))
    objective = objective_of(problem, readings, model)
    x = np.delete(starts, place, axis=1)
    with np.errstate(all="ignore"):
        if x.size:
            x = minimize(objective, LevenbergMarquardtMethod(1e-3), x, _LIMITS).x
        totals = objective.cost(x, objective.residual(x))
    best = int(np.argmin(np.where(np.isnan(totals), np.inf, totals)))
    total = float(totals[best])
    if released is not None:
        kept = np.setdiff1d(np.arange(len(released.x)), released.places)
        free = int(kept[place])
        start = _along(released.x, released.P, free, at)
        freed, less = _least_at(released.problem, z, free, at, start[None], None)
        # Outside of the bounds a smaller sum does not count.
        if released.inside(freed[None]).all():
            total = float(np.fmin(total, less))
    return model.whole(x)[best], total
