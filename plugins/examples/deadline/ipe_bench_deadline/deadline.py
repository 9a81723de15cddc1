"""The cost by which 99 % of trials are done."""

from __future__ import annotations

import numpy as np
from scipy.special import bdtr

from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.intervals import LEVEL, quantile
from ipe_bench.statistics.records import Statistic

DONE = 0.99


def limits(cost: Array, q: float = DONE) -> tuple[float, float]:
    """The distribution-free interval of a quantile, whose ends are costs (trials,) that occurred.

    The number of costs at or below the quantile is binomial, at least (Conover, Practical
    Nonparametric Statistics, 3rd ed., 1999, section 3.2). Too few trials bound the quantile on one
    side only: the other end is then infinite.
    """
    trials, tail = len(cost), (1 - LEVEL) / 2
    # With the cost of rank r as an end, r counted from 1: no more than `tail` beyond either.
    at_most = bdtr(np.arange(trials + 1), trials, q)
    low, high = int(np.searchsorted(at_most, tail)), int(np.searchsorted(at_most, 1 - tail)) + 1
    ordered = np.concatenate([[0.0], np.sort(cost), [np.inf]])
    return float(ordered[low]), float(ordered[min(high, trials + 1)])


STATISTIC = Statistic(
    "deadline",
    "done by",
    "all trials",
    "The cost by which 99 % of trials are done, well or not: in simulations, a Jacobian counting"
    " as many as it costs. Interval: distribution-free, from the order of the trials (Conover,"
    " Practical Nonparametric Statistics, 1999).",
    lambda s: quantile(s.cost, DONE),
    limits=lambda s: limits(s.cost),
    where=("terminal", "costs"),
    titles={"costs": "99 % done by"},
    limits_titles={"costs": "95 % of that"},
)
