"""What iterations did on their way to the limit: cost of coming close, orders of convergence, and the paper's bounds.

Iterates are (iterates, n), in multiples of the parameters' units; the last one stands for the limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array

CLOSE = 0.05
"""An iterate within this many standard deviations of the last one is as good as the last one."""
FLOOR = 1e-9
"""Distances below this are round-off."""


@dataclass(frozen=True)
class History:
    """How a converged trial came to its limit."""

    trial: str
    """The trial as readers name it."""
    iterates: Array
    distances: Array
    """(iterates,) from the last iterate, in deviations of the bound."""
    cost: float
    """Of the whole trial."""
    K: float
    """Of eq. (15) at the truth; NaN where it is not stored, as is M."""
    M: float
    """Of eq. (23) at the truth."""

    @property
    def cost_to_limit(self) -> float:
        """The cost of coming close; that of iterate k is its share (k + 1) / (iterates) of the trial's whole cost."""
        return self.cost * (iterations_to_limit(self.distances) + 1) / len(self.iterates)


def distances_to_limit(iterates: Array, deviation: Array) -> Array:
    """Largest component of each iterate's distance from the last one, in standard deviations (n,)."""
    with np.errstate(invalid="ignore"):
        return np.abs((iterates - iterates[-1]) / deviation).max(axis=1)


def iterations_to_limit(distances: Array) -> int:
    """The first iterate from which on all are within `CLOSE` of the last."""
    far = np.flatnonzero(~(distances <= CLOSE))
    return int(far[-1]) + 1 if len(far) else 0


def orders_of(errors: Array, floor: float = FLOOR) -> Array:
    """log(e_(k+1) / e_k) / log(e_k / e_(k-1)) of successive errors (iterates,), where they decrease above the floor:
    1 where convergence is linear, 2 where it is quadratic."""
    e = errors[: np.argmax(np.append(errors <= floor, True))]
    with np.errstate(divide="ignore", invalid="ignore"):
        orders = np.log(e[2:] / e[1:-1]) / np.log(e[1:-1] / e[:-2])
    decreasing = (e[2:] < e[1:-1]) & (e[1:-1] < e[:-2])
    return orders[decreasing]


def fixed_point_bound(iterates: Array, K: float, limit: Array | None = None) -> tuple[bool, float]:
    """Whether each iterate's largest error |x_k - limit| is at most K^k / (1 - K) |x_1 - x_0|, eq. (18) with the k that
    the print lost (Burden and Faires have it), and the largest such ratio among the iterates between the ends.

    The bound holds for a K that holds along the iterates; at a single point K is not a proven one. `limit` (n,) is the
    last iterate unless it is given.
    """
    error = np.abs(iterates - (iterates[-1] if limit is None else limit)).max(axis=1)
    step = np.abs(iterates[1] - iterates[0]).max()
    bound = K ** np.arange(len(iterates)) / (1 - K) * step if K < 1 else np.full(len(iterates), np.inf)
    inner = slice(1, -1)
    with np.errstate(all="ignore"):
        ratio = (error / bound)[inner][error[inner] > FLOOR].max(initial=0.0)
    return bool(np.all(error <= bound + 1e-12 * (1.0 + error.max()))), float(ratio)


def observed_constant(iterates: Array, limit: Array | None = None, floor: float = FLOOR) -> float:
    """The largest 2 e_(k+1) / (n^2 e_k^2) above the floor: the least M with which eq. (23),
    e_(k+1) <= n^2 M / 2 e_k^2, explains the iterates; NaN where they are over too soon."""
    limit = iterates[-1] if limit is None else limit
    errors = np.abs(iterates - limit).max(axis=1)
    usable = (errors[:-1] > floor) & (errors[1:] > floor)
    ratios = 2 * errors[1:][usable] / (iterates.shape[1] ** 2 * errors[:-1][usable] ** 2)
    return float(ratios.max()) if len(ratios) else np.nan
