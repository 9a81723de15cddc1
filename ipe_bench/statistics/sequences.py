"""Intervals that stay valid however often one looks, and whether they are narrow enough to stop.

Confidence sequences hold the true value at all numbers of trials at once with the stated probability; what is computed
and when is left to `api`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import betaln

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.intervals import Squares, few_carry

if TYPE_CHECKING:
    from ipe_bench.statistics.sample import Sample

LEVEL = 0.95
TIGHTEST = 1000
"""The number of trials at which sequences are about as narrow as they can be; at others they are valid as well."""
_WEIGHT = TIGHTEST / (2 * math.log(20) + math.log(2 * math.log(20)) + 1)
"""Of the mixtures, in trials: what makes those of 95 % tightest there (Waudby-Smith et al., 2024, appendix)."""
_STEPS = 60
FIRST = 100
"""Trials from which an asymptotic sequence begins; one that begins earlier misses errors with rare large ones."""


def share_sequence(count: int, trials: int, level: float = LEVEL) -> tuple[float, float]:
    """A share of which `count` in `trials` was seen: the hull of those p whose likelihood is not beaten by more than
    1/(1 - level) by that of a share drawn from a Beta distribution about p.

    That ratio is a martingale under p, so by Ville's inequality it ever exceeds this bound with at most the probability
    1 - level (Robbins, Ann. Math. Statist. 41, 1970; Howard, Ramdas, McAuliffe and Sekhon, Ann. Statist. 49, 2021).
    """
    if trials < 1:
        return np.nan, np.nan

    def beaten(p: float) -> bool:
        a, b, failures = _WEIGHT * p, _WEIGHT * (1 - p), trials - count
        mixture = float(betaln(a + count, b + failures) - betaln(a, b))
        own = (count * math.log(p) if count else 0.0) + (failures * math.log1p(-p) if failures else 0.0)
        return mixture - own > -math.log(1 - level)

    return _crossing(beaten, count / trials, 0.0), _crossing(beaten, count / trials, 1.0)


def _crossing(beaten: Callable[[float], bool], inside: float, outside: float) -> float:
    """Where, from the share that was seen to that end, shares begin to be beaten."""
    if inside == outside:
        return outside
    for _ in range(_STEPS):
        middle = (inside + outside) / 2
        if middle in (0.0, 1.0):
            return outside
        inside, outside = (inside, middle) if beaten(middle) else (middle, outside)
    return outside


def mean_sequence(deviation: Array, count: int, level: float = LEVEL) -> Array:
    """How far a mean of `count` values of that deviation may lie from its true value.

    The asymptotic confidence sequence of a Gaussian mixture (Waudby-Smith, Arbour, Sinha, Kennedy and Ramdas, Ann.
    Statist. 52, 2024, theorem 2.2), tightest at `TIGHTEST`: what the central limit theorem is to a fixed number of
    trials.
    """
    alpha, rho2 = 1 - level, 1 / _WEIGHT
    grown = count * rho2 + 1
    return deviation * math.sqrt(2 * grown / (count**2 * rho2) * math.log(math.sqrt(grown) / alpha))


def rms_sequence(squares: Array, level: float = LEVEL) -> tuple[Array, Array]:
    """Root mean square (k,) of squares (trials, k): the sequence of the logarithm of their mean; NaN below `FIRST`, and
    where few trials carry the sum, as those of one degree of freedom; see `few_carry`."""
    return rms_sequence_of(Squares.of(squares.T), np.ones(squares.shape[1]), level)


def rms_sequence_of(squares: Squares, degrees: Array, level: float = LEVEL) -> tuple[Array, Array]:
    """The same from what is known of them; see `rms_sequence`."""
    size, mean = squares.size, squares.mean
    if squares.count < FIRST:
        return np.full(len(size), np.nan), np.full(len(size), np.nan)
    with np.errstate(all="ignore"):
        reach = mean_sequence(squares.deviation / mean, squares.count, level) / 2
        root = np.sqrt(size * mean)
        ends = [np.where(size > 0, root * np.exp(side * reach), 0.0) for side in (-1, 1)]
    few = few_carry(squares, degrees)
    return np.where(few, np.nan, ends[0]), np.where(few, np.nan, ends[1])


# When to stop --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Precision:
    """How near to what is found the truth has to be, at whatever number of trials one looks; None where that is free.

    `success` is a difference of shares, of every estimator; `rmse` a ratio less 1, of the root mean square over
    parameters of error over bound, of the trials that an estimator solved.
    """

    success: float | None = None
    rmse: float | None = None

    @classmethod
    def of(cls, given: float | Mapping[str, float]) -> Precision:
        """From a number, which is that of success, or from numbers by name.

        Raises:
            UserError: it is neither.
        """
        known = tuple(f.name for f in fields(cls))
        named = {str(k): v for k, v in given.items()} if isinstance(given, Mapping) else {"success": given}
        for name, value in named.items():
            if name not in known:
                raise UserError(f"precision.{name}: {unknown(name, known, 'statistic')}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1:
                key = f"precision.{name}" if isinstance(given, Mapping) else "precision"
                raise UserError(f"{key}={value}: give a number between 0 and 1, such as 0.01")
        if not named:
            raise UserError("precision={}: give a number between 0 and 1, such as 0.01")
        return cls(**named)

    def reached(self, sample: Sample) -> list[Reach]:
        """How near each statistic that is asked for has come."""
        found = []
        if self.success is not None:
            low, high = share_sequence(int(sample.scalars["success"].sum()), len(sample))
            share = float(sample.scalars["success"].mean())
            found.append(Reach(sample.group.estimator, "success", max(high - share, share - low), self.success))
        if self.rmse is not None:
            low, high = (float(end[sample.n]) for end in sample.rmse_sequence)
            half = float(np.sqrt(high / low)) - 1 if low > 0 else np.inf
            found.append(Reach(sample.group.estimator, "rmse", half if np.isfinite(half) else np.inf, self.rmse))
        return found


@dataclass(frozen=True)
class Reach:
    """How near one statistic of an estimator has come to its true value."""

    estimator: str
    statistic: str
    width: float
    wanted: float

    @property
    def ratio(self) -> float:
        """Above 1 where it is not near enough yet."""
        return self.width / self.wanted

    def __str__(self) -> str:
        if math.isfinite(self.width):
            return f"{self.estimator}: {self.statistic} ± {100 * self.width:.2g} %"
        return f"{self.estimator}: {self.statistic} ± anything, since a few trials carry it or there are too few"


def next_trials(trials: int, ratio: float, block: int, most: int) -> int:
    """How many trials to have before looking again: what the widths ask for, at most twice as many as now, in whole
    blocks. Widths shrink with the root of the number."""
    wanted = 2.0 * trials if not math.isfinite(ratio) else min(2.0 * trials, 1.02 * trials * ratio**2)
    return min(most, max(trials // block + 1, math.ceil(wanted / block)) * block)
