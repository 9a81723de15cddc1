"""Examines a least-squares minimum beyond its standard errors: intervals that follow the bends of
the model, which readings carry the answer, and whether another answer fits as well.

What is examined is found in `examined`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, deviations, finite, repeated
from ipe_bench.basics.streams import generator
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.fits import at_rows
from ipe_bench.real.levels import Levelled, maximise_likelihood
from ipe_bench.real.on_bounds import OnBound
from ipe_bench.real.profiles import (
    CONFIDENCE,
    Released,
    half_width,
    joint_region,
    linear,
    profiles,
    wald_interval,
)
from ipe_bench.real.residuals import tested
from ipe_bench.real.within_bounds import answers
from ipe_bench.trials.thresholds import FIT_LEVEL

BOOTSTRAPS = 500
STARTS = 64
"""Points that the search for other minima begins from."""
_SPREADS = (1.0, 3.0)
"""Multiples of the prior's deviations with which these points are drawn, half of them with each."""
_WORK = 20_000_000
"""The most entries of Jacobians in one iteration of all draws or starts: there are fewer of very
many readings."""
_FEWEST = 4
"""The least number of starts."""
_FEWEST_DRAWS = 40
"""Draws below which there is no bootstrap: ends of 95 % intervals are the outermost one."""
_SAME = 1e-2
"""Minima closer than this, in standard errors of either, are one."""
LOWER = 1e-6
"""Sums of squares that differ by less than this share, or number, are those of one minimum."""
_SAME_READINGS = 1e-4
"""Answers whose readings differ by less than this, in standard deviations, are of one curve."""
_BENT = 0.1
"""Share of the half-width by which the ends of a bent profile differ from those of the standard
error."""


@dataclass(frozen=True)
class Minimum:
    """Holds a minimum of the sum of squares."""

    inner: Array
    """(n,) in the coordinates of the model."""
    x: Array
    """(n,) in the parameters' own units."""
    chi_square: float
    as_good: bool
    """Whether the readings do not tell it from the least one: their joint confidence region holds
    it."""
    same_readings: bool = False
    """Whether its readings are those of the estimate, so that no readings at all tell it from
    that."""


@dataclass(frozen=True)
class BootstrapIntervals:
    """Holds percentile intervals of answers to simulated readings of the model as estimated."""

    low: Array
    """Lower ends (n,) of percentile intervals, in the parameters' own units."""
    high: Array
    converged: int
    drawn: int


@dataclass(frozen=True, kw_only=True)
class Examination:
    """Examines a least-squares minimum; intervals and estimates are in the parameters' own
    units."""

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
    """Degrees of freedom behind the level of the noise, or (n,) behind each variance; None if R is
    known."""
    bootstraps: int
    overstated: bool = False
    """Whether the residuals are so far below the stated noise that no interval by chi-square means
    anything."""
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
        slope = self.model.physical_slope(self.inner[None])[0]
        return deviations(self.P) * np.abs(slope)

    @cached_property
    def wald(self) -> tuple[Array, Array]:
        """The intervals (n,), (n,) from the standard errors; NaN for levels of the noise."""
        q = half_width(CONFIDENCE, self.freedom)
        deviation = deviations(self.P)
        return self._without_levels(*wald_interval(self.model, self.inner, deviation, q))

    def _without_levels(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Intervals (n,), (n,) without those of levels of the noise.

        Only a profile holds a level as often as it says.
        """
        levels = np.arange(len(low)) >= self._mean.n
        return np.where(levels, np.nan, low), np.where(levels, np.nan, high)

    @cached_property
    def profiles(self) -> tuple[Array, Array]:
        """The profile intervals (n,), (n,); an end is infinite if the readings set no limit."""
        n = self._mean.n
        # The logarithm of a level does not follow a straight line: without correlations it is not
        # moved ahead.
        P = np.diag(np.diag(self.P))
        P[:n, :n] = self.P[:n, :n]
        return profiles(
            self.problem, self.z, self.inner, P, freedom=self.freedom, released=self.released
        )

    @property
    def bent(self) -> Mask:
        """The parameters (n,) whose profile intervals are not those of the standard errors."""
        low, high = self.profiles
        low_wald, high_wald = self.wald
        with np.errstate(invalid="ignore"):
            apart = np.maximum(np.abs(low - low_wald), np.abs(high - high_wald))
            alike = apart <= _BENT * (high_wald - low_wald) / 2
        # An end that is not known makes the two no more alike.
        return ~alike & (np.arange(len(low)) < self._mean.n)

    @cached_property
    def fitted(self) -> Array:
        """h (m,) at the estimate, where readings are missing too."""
        return self.whole.measurement.simulate(self._place)[0]

    @cached_property
    def fitted_errors(self) -> Array:
        """Standard errors (m,) of `fitted`: the roots of the diagonal of J P J'."""
        J = self.whole.measurement.jacobian(self._place)[0]
        n = J.shape[1]
        variances = np.einsum("ij,jk,ik->i", J, self.P[:n, :n], J)
        return np.sqrt(np.maximum(variances, 0.0))

    @property
    def new_errors(self) -> Array:
        """Standard errors (m,) of a further reading, with its noise; NaN if that is not known."""
        known = self.problem.R.deviations
        # If all readings are as good, so is one that is missing.
        same = np.ptp(known) <= 1e-12 * known[0]
        return np.hypot(self.fitted_errors, known[0] if same else self._at_rows(known))

    def _at_rows(self, values: Array) -> Array:
        """Places values of the readings that are present among all (m,)."""
        return at_rows(self.rows, values, self.whole.R.m)

    @property
    def shift(self) -> Array:
        """The move (m,) without a reading of the parameter that moves most, in standard errors; NaN
        if the reading is missing."""
        return self._at_rows(self._moves.max(axis=0))

    @property
    def moved(self) -> Array:
        """The place (m,) of the parameter that moves most without a reading; NaN if it is
        missing."""
        return self._at_rows(self._moves.argmax(axis=0).astype(float))

    @cached_property
    def _moves(self) -> Array:
        """Moves (n, k) of the parameters without one of the k readings that are there, in standard
        errors.

        By the linear model about the estimate, without reading i that is P J_i' e_i, e_i being its
        estimated error (Cook and Weisberg, Residuals and Influence in Regression, 1982).
        """
        R = self.problem.R
        n = self._J.shape[1]
        P = self.P[:n, :n]
        w = R.whiten(self.z - self._present)
        Q, _ = np.linalg.qr(self._J)
        statistic, variance = tested(w, Q, R)
        # Of correlated readings it is R^-1 J that a single reading's error acts through.
        slopes = self._J if R.factor.ndim == 1 else R.whiten(np.eye(len(w))) @ self._J
        with np.errstate(all="ignore"):
            moved = P @ slopes.T * (statistic / variance)
            in_errors = np.abs(moved / deviations(P)[:, None])
        return in_errors

    @cached_property
    def bootstrap(self) -> BootstrapIntervals:
        """Estimates within the bounds from readings simulated at the estimate with noise of R,
        always the same draws (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section
        6.5).

        If the level of the noise is estimated, each set has a level that the true one may be, given
        the estimate, so that intervals are those of Student's t if the model is linear.
        """
        draws = self._affordable(self.bootstraps)
        unknown = np.full(len(self.x), np.nan)
        if draws < max(1, min(_FEWEST_DRAWS, self.bootstraps)):
            return BootstrapIntervals(unknown, unknown, 0, 0)
        z = self._present + self._drawn_noise(draws)
        free = self.released
        if free is None:
            values, answered = answers(self.problem, z, repeated(self.inner, draws))
        else:
            values, answered = answers(free.problem, z, repeated(free.x, draws), free)
            values = np.delete(values, free.places, axis=1)
        values = values[answered]
        if len(values) < draws / 2:
            return BootstrapIntervals(unknown, unknown, len(values), draws)
        tail = (1 - CONFIDENCE) / 2
        low, high = self._without_levels(*np.quantile(values, [tail, 1 - tail], axis=0))
        return BootstrapIntervals(low, high, len(values), draws)

    def _drawn_noise(self, draws: int) -> Array:
        """Draws noise (draws, m) of R, with a level of its own in each set if the level is
        estimated."""
        rng = generator(0)
        e = rng.standard_normal((draws, len(self.z)))
        if isinstance(self.freedom, int):
            # f s^2 / sigma^2 is chi-square of f degrees of freedom.
            levels = np.sqrt(self.freedom / rng.chisquare(self.freedom, draws))
            e *= levels[:, None]
        factor = self.problem.R.factor
        return e * factor if factor.ndim == 1 else e @ factor.T

    def _affordable(self, wanted: int) -> int:
        return min(wanted, max(_FEWEST, _WORK // self._J.size))

    @cached_property
    def minima(self) -> list[Minimum]:
        """Minima, the least first, reached from the estimate and from starts that the prior
        draws."""
        starts = self._starts()
        minima = maximise_likelihood(self.problem, repeated(self.z, len(starts)), starts)
        usable = minima.converged & np.isfinite(minima.chi_square) & finite(minima.covariance)
        least_first = np.argsort(minima.chi_square[usable], kind="stable")
        found: list[Minimum] = []
        places: list[tuple[Array, Array]] = []
        for i in np.flatnonzero(usable)[least_first]:
            x = minima.x[i]
            deviation = deviations(minima.covariance[i])
            # Starts end at one minimum again and again: it counts once.
            if any(_alike(x, y, np.maximum(deviation, d)) for y, d in places):
                continue
            places.append((x, deviation))
            chi_square = float(minima.chi_square[i])
            least = found[0].chi_square if found else chi_square
            as_good = chi_square - least <= self._region(least, CONFIDENCE)
            values = self.model.physical(x[None])[0]
            found.append(Minimum(x, values, chi_square, as_good, self._has_same_readings(x)))
        return found or [Minimum(self.inner, self.x, self.chi_square, True)]

    def _region(self, least: float, confidence: float) -> float:
        """Computes how far chi-square rises by chance from its least value to the true
        parameters."""
        n = len(self.inner)
        if not isinstance(self.freedom, int):
            return joint_region(n, confidence, None)
        # The level of the noise is that at the least value.
        level = min(1.0, least / self.freedom)
        return level * joint_region(n, confidence, self.freedom)

    def _starts(self) -> Array:
        """Draws starts (starts, n) from the prior, behind the estimate; none if it is known that
        there is one minimum."""
        if linear(self.model):
            return self.inner[None]
        problem = self.problem
        n = len(self.inner)
        spread = np.ones(n) if problem.prior_deviation is None else problem.prior_deviation
        reach = np.repeat(_SPREADS, self._affordable(STARTS) // len(_SPREADS))[:, None]
        normal = generator(1).standard_normal((len(reach), n))
        drawn = problem.x0 + reach * spread * normal
        return np.concatenate([self.inner[None], drawn])

    def _has_same_readings(self, x: Array) -> bool:
        """Tells whether the readings at x (n,) are those at the estimate."""
        with np.errstate(all="ignore"):
            moved = self._mean.simulate(x[None, : self._mean.n])[0] - self._present
        apart = np.abs(self.problem.R.whiten(moved))
        return bool((apart < _SAME_READINGS).all())

    @property
    def least(self) -> bool:
        """Tells whether no minimum that was found is lower by more than chance explains."""
        least = self.minima[0].chi_square
        chance = self._region(least, 1 - FIT_LEVEL)
        return self.chi_square <= least + chance + LOWER * max(1.0, self.chi_square)

    @property
    def ambiguous(self) -> list[Minimum]:
        """Other minima that fit as well."""
        apart = _SAME * self.standard_errors
        as_good = [one for one in self.minima if one.as_good]
        return [one for one in as_good if (np.abs(one.x - self.x) > apart).any()]


def _alike(x: Array, y: Array, deviation: Array) -> bool:
    """Tells whether two minima (n,) are one."""
    return bool((np.abs(x - y) <= _SAME * deviation).all())
