"""How coarsely tangents may be integrated inside iterations: by a contraction that is measured on the model itself.

A Gauss-Newton step with a Jacobian J~ in place of J leaves |I - J~+ J| of the error that it set out to remove. That is
measured at the nominal parameters, for a cheaper formula and for longer steps, and carried over to a trial by the level
that step doubling has found for it. Integrating is left to `model`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array

CONTRACTION = 1e-3
"""What is aimed at where it is measured or predicted; elsewhere it may be some times larger."""
MOST_RK4 = 3
"""Steps of the formula of fourth order, in place of one of eighth order, beyond which it gains nothing."""
_LONGEST = 5
"""Times that the steps of tangents may be longer than those of the readings."""
_ORDER = 8


def contraction(coarse: Array, J: Array) -> float:
    """|I - J~+ J| in the spectral norm: what is left of an error after a step with J~ (m, n) in place of J."""
    if not (np.isfinite(coarse).all() and np.isfinite(J).all()):
        return np.inf
    size = np.linalg.norm(J, axis=0)
    size[size == 0] = 1.0
    return float(np.linalg.norm(np.eye(J.shape[1]) - np.linalg.lstsq(coarse / size, J / size, rcond=None)[0], 2))


@dataclass(frozen=True)
class Coarseness:
    """What was measured on a model."""

    rk4: int | None
    """Steps of the formula of fourth order that contract enough at the coarsest level; None: none do."""
    sensitivity: float
    """The contraction factor for each tolerance by which readings are off."""

    def level(self, n: int) -> int:
        """The level for the tangents of a trial at level n: n / 5, or whatever leaves the contraction that is aimed
        at, where readings at level n are within a sixteenth of the tolerance."""
        affordable = (16 * CONTRACTION / self.sensitivity) ** (1 / _ORDER) if self.sensitivity > 0 else np.inf
        return max(1, int(np.ceil(n / np.clip(affordable, 1.0, _LONGEST))))
