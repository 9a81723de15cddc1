"""How many trials a comparison of success needs, from those that there are.

McNemar's exact test decides by the trials in which one estimator alone succeeds: their number is binomial, and so is
the number of those that the second wins, so that the power is a sum (Duffy, Biometrics 40, 1984).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import bdtr

from ipe_bench.basics.errors import UserError
from ipe_bench.statistics.calibration import least_count
from ipe_bench.statistics.consistency import clopper_pearson
from ipe_bench.trials.thresholds import FEW

LIMIT = 0.8
"""Confidence of the upper limit of the discordant share: a plan by the share that a pilot shows is too small as often
as not."""
MOST = 10_000_000
"""Plans end at this many trials."""
_SAW = 20
"""Trials over which the power, which is a saw in their number, must stay."""
PLANNED = ("power", "difference", "discordant", "discordant_high", "trials_needed")
"""The columns that a plan adds to a row on success."""


@dataclass(frozen=True)
class Plan:
    """What is wanted: a difference of success, second less first, is found with this probability."""

    power: float
    difference: float

    def row(self, discordant: int, trials: int, alpha: float) -> dict[str, Any]:
        """The columns `PLANNED`, from the number of trials, and of those in which one alone succeeds.

        Raises:
            UserError: there are too few trials to plan from, or the plan has more than `MOST`.
        """
        if trials < FEW:
            raise UserError(f"power: {trials} common trials are too few to plan from; run at least {FEW}")
        # One end of an interval leaves out half of what both do.
        high = clopper_pearson(discordant, trials, 2 * LIMIT - 1)[1]
        needed = trials_needed(max(high, self.difference), self.difference, self.power, alpha)
        values = self.power, self.difference, discordant, high, needed
        return dict(zip(PLANNED, values, strict=True))


def plan_of(power: float | None, difference: float | None, *, anytime: bool = False) -> Plan | None:
    """The plan that is asked for; None if none is.

    Raises:
        UserError: one of both is missing or no share, or the findings are those of e-values.
    """
    if power is None and difference is None:
        return None
    if power is None or difference is None:
        missing = "power" if power is None else "difference"
        raise UserError(f"{missing}: is not given; both go together, such as power=0.9 difference=0.05")
    for name, value, example in (("power", power, 0.9), ("difference", difference, 0.05)):
        if not 0 < value < 1:
            raise UserError(f"{name}={value}: give a number between 0 and 1, such as {example}")
    if anytime:
        raise UserError("power: is that of a fixed number of trials; leave out anytime, or see precision= of run")
    return Plan(power, difference)


def mcnemar_power(trials: int, share: float, difference: float, alpha: float) -> float:
    """The probability that McNemar's exact test at the level `alpha` finds a difference of success, where one estimator
    alone succeeds in a `share` of the trials."""
    mean, reach = trials * share, 8 * np.sqrt(trials * share * (1 - share)) + 8
    m = np.arange(max(1, int(mean - reach)), min(trials, int(mean + reach)) + 1)
    probability = bdtr(m, trials, share) - bdtr(m - 1, trials, share)
    # The most that the loser may win for the test to reject.
    edge = least_count(m, np.array(0.5), np.array(alpha / 2)) - 1
    won = (1 + difference / share) / 2
    rejects = bdtr(np.maximum(edge, 0), m, won) + bdtr(np.maximum(edge, 0), m, 1 - won)
    return float(np.sum(probability * np.where(edge >= 0, rejects, 0.0)))


def trials_needed(share: float, difference: float, power: float, alpha: float) -> int:
    """The least number of trials from which on the power is had.

    Raises:
        UserError: it is above `MOST`.
    """

    def enough(trials: int) -> bool:
        return mcnemar_power(trials, share, difference, alpha) >= power

    low, high = 0, 8
    while not enough(high):
        low, high = high, 2 * high
        if high > MOST:
            raise UserError(f"difference={difference:g}: needs more than {MOST:,} trials; ask for a larger difference")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    while below := [n for n in range(high, high + _SAW) if not enough(n)]:
        high = below[-1] + 1
    return high
