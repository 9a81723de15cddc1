"""What iterations did on their way to the limit: the cost of coming close, and the orders of convergence.

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
    distances: Array
    """(iterates,) from the last iterate, in deviations of the bound."""
    cost: float
    """Of the whole trial."""

    @property
    def cost_to_limit(self) -> float:
        """The cost of coming close; that of iterate k is its share (k + 1) / (iterates) of the trial's whole cost."""
        return self.cost * (iterations_to_limit(self.distances) + 1) / len(self.distances)


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
