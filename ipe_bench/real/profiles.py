"""Profile-likelihood intervals: what the readings say of one parameter when all others adapt to it.

Where the model bends, these hold what they promise and intervals from standard errors do not (Venzon and Moolgavkar,
Applied Statistics 37, 1988; Bates and Watts, Nonlinear Regression Analysis and Its Applications, 1988, section 6.1).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.estimators.least_squares import Objective, minimize, squared
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.counted import Counted, Tally
from ipe_bench.measurements.problem import Problem

_FIRST = (0.5, 1.0, 1.5)
"""Where a profile is looked at first on either side, in multiples of the half-width from standard errors."""
_ROUNDS = 24
"""Further looks at each end,"""
_STRETCH = 2.0
"""each at most so many times as far away as the last."""
_PRECISION = 1e-4
"""of the half-width, to which an end is found."""
_TOLERANCE = 1e-7
_MOST_STEPS = 100
_LOWER = 1e-6
"""Less of chi-square than at the estimate, by more than this, is another and lower minimum."""


@dataclass(frozen=True)
class Profile:
    """One parameter's profile: where it was looked at, and the interval."""

    values: Array
    """Values (points,) of the parameter, ascending, in its own unit; the estimate among them."""
    zeta: Array
    """The signed root of the rise of chi-square (points,): a straight line through zero where the model is linear."""
    low: float
    """Ends of the interval in the parameter's unit; infinite where the readings set no limit."""
    high: float
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


@dataclass(frozen=True, kw_only=True)
class Pinned(Counted):
    """A model in which one parameter of each trial has a value of its own, and x are the others."""

    places: NDArray[np.intp]
    """Which parameter, for each trial of the tally,"""
    values: Array
    """and its value."""

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


_ON_BOUND = 1e-9
"""Share of the start's distance from a bound within which a value is on it: round-off of what is a logarithm."""


def natural(model: Measurement, x: Array) -> Array:
    """Values (points, n) in the parameters' own units, exactly on a bound where they are as good as there."""
    ends = _limits(model)
    values, start = model.natural(x), model.natural(model.nominal[None])
    for bound in ends:
        near = np.isfinite(bound) & (np.abs(values - bound) <= _ON_BOUND * np.abs(start - bound))
        values = np.where(near, bound, values)
    return values


def _limits(model: Measurement) -> Array:
    """The lower and the upper bound (2, n) of each parameter, in its own unit; infinite where there is none."""
    return np.sort(model.natural(np.stack([np.full(model.n, -np.inf), np.full(model.n, np.inf)])), axis=0)


def wald(model: Measurement, x: Array, half: Array) -> tuple[Array, Array]:
    """Ends (n,), (n,) of the intervals x +- half in the parameters' own units.

    They are those of the logarithm of a bounded parameter's distance from its bound, in which its errors are more
    nearly normal, unless the bound is within the interval that is symmetric in its own unit: then they are those of
    that interval, which ends on the bound, because the logarithm of what may be 0 has no normal errors.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        ends = np.sort(natural(model, np.stack([x - half, x + half])), axis=0)
        values, slope = model.natural(x[None])[0], model.natural_slope(x[None])[0]
        low, high = values - half * np.abs(slope), values + half * np.abs(slope)
        bounds = _limits(model)
        reached = (low <= bounds[0]) & np.isfinite(bounds[0]) | (high >= bounds[1]) & np.isfinite(bounds[1])
        symmetric = np.clip(np.stack([low, high]), *bounds)
    found = np.where(reached, symmetric, ends)
    return found[0], found[1]


def half_width(level: float, freedom: int | None) -> float:
    """The quantile that a rise of root chi-square is compared with: normal, or Student's t where the level of the noise
    is estimated from `freedom` degrees of freedom."""
    return float(stdtrit(np.inf if freedom is None else freedom, (1 + level) / 2))


def profiles(
    problem: Problem, z: Array, x: Array, P: Array, *, confidence: float = 0.95, freedom: int | None = None
) -> list[Profile]:
    """A profile of every parameter about the least-squares estimate x (n,) of covariance P (n, n).

    z (m,) are the readings, all present. `freedom`: see `half_width`; R is then what it was estimated to be.
    """
    return profiles_of_sets(problem, z[None], x[None], P[None], confidence=confidence, freedom=freedom)[0]


def profiles_of_sets(
    problem: Problem,
    z: Array,
    x: Array,
    P: Array,
    *,
    levels: Array | None = None,
    confidence: float = 0.95,
    freedom: int | None = None,
) -> list[list[Profile]]:
    """Those of several sets of readings z (sets, m) at once, with estimates x (sets, n) and covariances P (sets, n, n).

    `levels` (sets,): what each set has found R^1/2 to be multiplied by, and P has been multiplied by the square of.
    """
    sets, n = x.shape
    levels = np.ones(sets) if levels is None else levels
    q = half_width(confidence, freedom)
    least = squared(problem.R.whiten(problem.measurement.simulate(x) - z))
    each = [_Set(problem, z[k], x[k], P[k], float(levels[k]), float(least[k])) for k in range(sets)]
    looked = [_Looked(one, j, q) for one in each for j in range(n)]
    _find_ends(problem, looked)
    return [[one.profile() for one in looked[k * n : (k + 1) * n]] for k in range(sets)]


def end_within(
    problem: Problem,
    z: Array,
    x: Array,
    P: Array,
    place: int,
    sign: int,
    *,
    confidence: float = 0.95,
    freedom: int | None = None,
) -> float:
    """The other end, in its own unit, of the profile interval of a parameter whose estimate is on a bound; x (n,) is
    the minimum with it there, and `sign` leads inwards. Infinite where the readings set no limit, NaN where the bound
    is not the minimum.

    The rise of chi-square is compared with the same quantile as inside of bounds. Below the bound the true value may be
    anywhere, and an estimate on the bound is only nearer to it than one beyond would be: the interval holds it at
    least as often as it says, from 95 to 97.5 % where the model is linear.
    """
    q = half_width(confidence, freedom)
    least = float(squared(problem.R.whiten(problem.measurement.simulate(x[None]) - z))[0])
    looked = _Looked(_Set(problem, z, x, P, 1.0, least), place, q)
    _find_ends(problem, [looked], signs=(sign,))
    if looked.lower:
        return np.nan
    end = looked.centre + sign * looked.end(sign)
    return float(looked.natural(np.array([end]))[0])


@dataclass(frozen=True)
class Released:
    """A problem in which parameters that are on their bounds may leave them inwards."""

    problem: Problem
    """With those parameters free of bounds,"""
    x: Array
    """the minimum (n,) with them on their bounds,"""
    P: Array
    """and the covariance (n, n) there."""
    places: NDArray[np.intp]
    """Which of the parameters they are,"""
    inwards: Array
    """and the sign that leads inwards, of each."""

    @property
    def others(self) -> NDArray[np.intp]:
        return np.setdiff1d(np.arange(len(self.x)), self.places)

    def relax(self, z: Array, asked: _Asked) -> None:
        """Lowers what was seen with the parameters on their bounds to what is seen where they leave them."""
        places = self.others[[one.place for one, _ in asked]]
        values = np.array([at for _, at in asked])
        moved = (values - self.x[places]) / self.P[places, places]
        begin = self.x + self.P[:, places].T * moved[:, None]
        x, sums = _fit_others(self.problem, places, values, np.repeat(z[None], len(asked), axis=0), begin)
        left = (x - self.x)[:, self.places] * self.inwards
        inwards = np.all(left >= 0, axis=1)
        for (one, at), total, inside in zip(asked, sums.tolist(), inwards, strict=True):
            if inside and np.isfinite(total):
                one.lower_to(at, total)


def profiles_within(
    problem: Problem,
    z: Array,
    x: Array,
    P: Array,
    released: Released,
    *,
    confidence: float = 0.95,
    freedom: int | None = None,
) -> list[Profile]:
    """Those of the parameters that are not on bounds, about the minimum x (n,) with the others held there: the latter
    may move inwards where that fits better, so that the intervals are not those of parameters that are known."""
    q = half_width(confidence, freedom)
    least = float(squared(problem.R.whiten(problem.measurement.simulate(x[None]) - z))[0])
    whole = _Set(problem, z, x, P, 1.0, least)
    looked = [_Looked(whole, j, q) for j in range(len(x))]
    _find_ends(problem, looked, relax=lambda asked: released.relax(z, asked))
    return [one.profile() for one in looked]


@dataclass(frozen=True)
class _Set:
    """A set of readings with its estimate; see `profiles_of_sets`."""

    problem: Problem
    z: Array
    x: Array
    P: Array
    level: float
    least: float
    """The sum of squares at the estimate, of readings whitened by R as it is."""


class _Looked:
    """What has been seen of one profile so far."""

    def __init__(self, whole: _Set, place: int, q: float) -> None:
        self.whole, self.place, self.q = whole, place, q
        self.centre = float(whole.x[place])
        self.deviation = float(np.sqrt(whole.P[place, place]))
        self.seen: dict[float, tuple[float, Array]] = {self.centre: (0.0, whole.x)}
        self.open = {-1: False, 1: False}
        self.lower = False

    def lower_to(self, at: float, total: float) -> None:
        """Notes a sum of squares at a value where a larger one has been seen."""
        level, least = self.whole.level, self.whole.least
        change = (total - least) / level**2
        zeta, point = self.seen[at]
        if change < zeta**2:
            self.lower |= change < -_LOWER * max(1.0, least / level**2)
            self.seen[at] = (float(np.sign(at - self.centre) * np.sqrt(max(change, 0.0))), point)

    def side(self, sign: int) -> list[tuple[float, float]]:
        """(distance, abs zeta) on one side, outwards from the estimate."""
        found = [(v - self.centre, abs(zeta)) for v, (zeta, _) in self.seen.items() if sign * (v - self.centre) >= 0]
        return sorted((abs(distance), zeta) for distance, zeta in found)

    def crossing(self, sign: int) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """The first neighbours between which the profile rises over q."""
        points = self.side(sign)
        return next(((a, b) for a, b in itertools.pairwise(points) if a[1] < self.q <= b[1]), None)

    def end(self, sign: int) -> float:
        """The distance to the end of the interval, by linear interpolation."""
        found = self.crossing(sign)
        if found is None:
            return np.inf
        (near, below), (far, above) = found
        return far if above == below else near + (far - near) * (self.q - below) / (above - below)

    def next(self, sign: int) -> float | None:
        """Where to look next for an end; None where it is known, or there is none."""
        found = self.crossing(sign)
        if self.lower or self.open[sign]:
            return None
        if found is None:
            distance, zeta = self.side(sign)[-1]
            if not np.isfinite(zeta) or distance > 1e6 * self.q * self.deviation:
                self.open[sign] = True
                return None
            return self.centre + sign * distance * min(_STRETCH, max(1.1, 1.05 * self.q / max(zeta, 1e-3)))
        (near, below), (far, above) = found
        distance = self.end(sign) if np.isfinite(above) else (near + far) / 2
        close = min(self.q - below, above - self.q) <= _PRECISION * self.q
        if close or far - near <= _PRECISION * self.q * self.deviation * 1e-3:
            return None
        # Interpolation alone may creep up to the end from one side.
        return self.centre + sign * float(np.clip(distance, near + 0.05 * (far - near), far - 0.05 * (far - near)))

    def profile(self) -> Profile:
        values = np.array(sorted(self.seen))
        zeta = np.array([self.seen[v][0] for v in values])
        centre, half = self.centre, self.q * self.deviation
        with np.errstate(invalid="ignore"):
            own = self.natural(np.concatenate([[centre - self.end(-1), centre + self.end(1)], values]))
        low, high = sorted(own[:2])
        widths = np.zeros(len(self.whole.x))
        widths[self.place] = half
        ends = [float(end[self.place]) for end in wald(self.whole.problem.measurement, self.whole.x, widths)]
        order = np.argsort(own[2:])
        zeta = zeta if own[3] >= own[2] else -zeta
        return Profile(own[2:][order], zeta[order], float(low), float(high), (ends[0], ends[1]), self.lower)

    def natural(self, values: Array) -> Array:
        """Values of the parameter in its own unit."""
        points = np.repeat(self.whole.x[None], len(values), axis=0)
        points[:, self.place] = values
        return natural(self.whole.problem.measurement, points)[:, self.place]


_Asked: TypeAlias = "list[tuple[_Looked, float]]"
"""Which parameters of which sets are to be looked at, and where."""


def _find_ends(
    problem: Problem,
    looked: Sequence[_Looked],
    signs: Sequence[int] = (-1, 1),
    relax: Callable[[_Asked], None] | None = None,
) -> None:
    """Looks at all these parameters in rounds, until their ends on these sides are found; `relax` may lower what a
    round has seen."""
    asked = [(one, one.centre + s * f * one.q * one.deviation) for one in looked for s in signs for f in _FIRST]
    for _ in range(_ROUNDS + 1):
        _look(problem, asked)
        if relax is not None:
            relax(asked)
        asked = [(one, at) for one in looked for sign in signs if (at := one.next(sign)) is not None]
        if not asked:
            break


def _look(problem: Problem, asked: _Asked) -> None:
    """Minimises over the other parameters at every place that is asked for, all in one batch."""
    places, values = np.array([one.place for one, _ in asked]), np.array([at for _, at in asked])
    readings = np.stack([one.whole.z for one, _ in asked])
    begin = np.stack([_nearest(one, at) for one, at in asked])
    full, sums = _fit_others(problem, places, values, readings, begin)
    for (one, at), total, point in zip(asked, sums.tolist(), full, strict=True):
        level, least = one.whole.level, one.whole.least
        change = (total - least) / level**2
        one.lower |= change < -_LOWER * max(1.0, least / level**2)
        zeta = np.sqrt(max(change, 0.0)) if np.isfinite(change) else np.inf
        one.seen[at] = (float(np.sign(at - one.centre) * zeta), point)


def _fit_others(
    problem: Problem, places: NDArray[np.intp], values: Array, readings: Array, begin: Array
) -> tuple[Array, Array]:
    """The minima (asked, n) with the parameters `places` at `values` (asked,), and the sums of squares there (asked,),
    for readings (asked, m), from `begin` (asked, n)."""
    rows = np.arange(len(values))
    model = Pinned(problem.measurement, Tally.zeros(len(values)), places=places, values=values)
    x = np.stack([np.delete(start, place) for start, place in zip(begin, places, strict=True)])
    with np.errstate(all="ignore"):
        if x.shape[1]:
            objective = Objective(model, problem.R, readings, rows, problem.x0)
            method = LevenbergMarquardtMethod(1e-3)
            x = minimize(objective, method, x, tolerance=_TOLERANCE, max_iterations=_MOST_STEPS).x
        sums = squared(problem.R.whiten(model.simulate(x, rows) - readings))
    return model.whole(x, rows), sums


def _nearest(one: _Looked, at: float) -> Array:
    """Where to start for that value: the nearest point seen, moved along the line on which the others would follow in a
    linear model."""
    P = one.whole.P
    known = [v for v, (zeta, _) in one.seen.items() if np.isfinite(zeta)]
    nearest = min(known, key=lambda v: abs(v - at))
    start = one.seen[nearest][1] + P[:, one.place] / P[one.place, one.place] * (at - nearest)
    start[one.place] = at
    return start
