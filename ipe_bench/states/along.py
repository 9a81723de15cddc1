"""The functions f and h of a state model with their slopes, at one epoch and along whole paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import differentiate


class Along(NamedTuple):
    """Holds f and h of a state model along paths of K epochs, with their slopes."""

    f: Array
    """f of the states before each epoch (trials, K, n); those states themselves if no transition leads there."""
    h: Array
    """h of the states at each epoch (trials, K, m)."""
    F: Array
    """df/dx (trials, K, n, n)."""
    H: Array
    """dh/dx (trials, K, m, n)."""


@dataclass(frozen=True)
class AtEpoch:
    """A function of states x (..., n) at one epoch, which knows its slopes."""

    function: Callable[[Array, int], Array]
    k: int

    def __call__(self, x: Array) -> Array:
        return self.function(x, self.k)

    def slope(self, x: Array) -> tuple[Array, Array]:
        """Computes value (trials, m) and Jacobian (trials, m, n) at x (trials, n)."""
        return self(x), differentiate(self, x, analytic=True)


def unmoved(x: Array) -> tuple[Array, Array]:
    """Returns the states (trials, n) and their slopes where no transition leads into an epoch."""
    n = x.shape[-1]
    return x, np.broadcast_to(np.eye(n), (*x.shape, n))
