"""Which known minimum of a test function of Moré, Garbow and Hillstrom an estimate attains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.mgh.model import Mgh

RELATIVE = 1e-6
ABSOLUTE = 1e-12


@dataclass(frozen=True)
class Attained:
    """How low an estimate's sum of squares is."""

    sum_of_squares: float
    """At the estimate; infinite where it is not a number."""
    solved: bool
    """Whether that is the least there is."""
    minimum: int | None
    """Which of the model's `minima` has this sum of squares: 0 where solved; None: it is none of them."""


def score(model: Mgh, x: Array) -> Attained:
    """Compares the sum of squares at an estimate x (n,), in multiples of sizes, with the known minima.

    A minimum f* is attained where f(x) <= f* (1 + 1e-6) + 1e-12. The value decides and not the place: several functions
    have more than one minimiser, or a minimum so flat that its place says nothing. The absolute term is for minima of
    zero; it is 1e-4 of the smallest other one, Gaussian's 1.1e-8.
    """
    with np.errstate(all="ignore"):
        f = model.simulate(np.asarray(x, dtype=float)[None])[0]
        value = float(f @ f)
    if not np.isfinite(value):
        return Attained(np.inf, False, None)
    least = [m.sum_of_squares for m in model.minima]
    if value <= least[0] + _tolerance(least[0]):
        return Attained(value, True, 0)
    near = (k for k, other in enumerate(least) if abs(value - other) <= _tolerance(other))
    return Attained(value, False, next(near, None))


def _tolerance(least: float) -> float:
    return RELATIVE * least + ABSOLUTE
