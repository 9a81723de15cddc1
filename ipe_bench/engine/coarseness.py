"""Determines how coarse the tangents inside an iteration may be.

A Gauss-Newton step with a Jacobian J~ in place of J leaves |I - J~+ J| of the error: tangents that
are integrated with longer steps, or by a cheaper formula, cost a contraction, and no accuracy. That
is measured at the nominal parameters and carried over to other trials by their rung.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.engine.ladder import ORDER, SAFETY

AIM = 1e-3
"""The contraction of coarse tangents that is aimed at where it is measured or predicted; elsewhere
it may be some times larger."""
MOST_OF_FOURTH = 3
"""Steps of the formula of fourth order, in place of one of eighth order, beyond which it gains
nothing."""
HIGHEST_OF_FOURTH = 2
"""The highest rung at which it is tried: up to here its stages, 4 (rung + 1) at least, are not more
than the 12 of a single step of eighth order."""
LONGEST = 5
"""Times that the steps of tangents may be longer than those of the readings."""


def tangent_contraction(coarse: Array, J: Array) -> float:
    """Computes |I - J~+ J| in the spectral norm: the share of an error after a step with J~ (m, n)
    in place of J."""
    if not (np.isfinite(coarse).all() and np.isfinite(J).all()):
        return np.inf
    # Columns are scaled, so that the contraction does not depend on the parameters' units.
    size = np.linalg.norm(J, axis=0)
    size[size == 0] = 1.0
    steps = np.linalg.lstsq(coarse / size, J / size, rcond=None)[0]
    return float(np.linalg.norm(np.eye(J.shape[1]) - steps, 2))


class Coarseness(NamedTuple):
    """Holds how coarse the tangents inside an iteration may be, as measured at the nominal
    parameters."""

    fourth: int | None
    """Steps of the formula of fourth order that contract enough at rung 1; None: none do."""
    longer: float
    """Ratio of the steps of tangents to those of the readings, both by the formula of eighth
    order."""

    def steps(self, rung: int) -> tuple[bool, int]:
        """Returns whether the formula is that of fourth order, and the steps between two readings,
        for trials at this rung; 0 stands for trials whose rung is known without a search."""
        # Eighth order: the steps of the readings, as many times longer as was measured to contract.
        if rung > HIGHEST_OF_FOURTH or self.fourth is None:
            fewer = max(rung, 1) / self.longer
            return False, max(1, int(np.ceil(fewer)))
        # The formula of fourth order loses more by what a trial turns faster than the nominal one:
        # at rung 1 there is 2^4 in hand, at rung 2 it is 3^4.
        return True, self.fourth * (rung + 1 if rung else 1)


def fewest_of_fourth(tangents: Callable[[int], Array], J: Array) -> int | None:
    """Returns the fewest steps k of the formula of fourth order for which tangents(k) (m, n)
    contract enough beside J (m, n), or None."""
    for k in range(1, MOST_OF_FOURTH + 1):
        if tangent_contraction(tangents(k), J) <= AIM:
            return k
    return None


def times_longer(off: Array, coarse: Array, J: Array) -> float:
    """Returns how many times longer than those of the readings the steps of tangents may be, from
    longer ones: `off` (m,) is by how much they change the readings, in tolerances, and `coarse` (m,
    n) is their Jacobian.

    Readings are held to 1/`SAFETY` of the tolerance; the contraction grows with the error, and so
    with the eighth power of the step.
    """
    with np.errstate(all="ignore"):
        sensitivity = tangent_contraction(coarse, J) / off.max()
    if not np.isfinite(sensitivity):
        return 1.0
    # contraction = sensitivity * error, error ~ h^8: the ratio of steps that reaches the aim.
    longer = (SAFETY * AIM / sensitivity) ** (1 / ORDER) if sensitivity > 0 else np.inf
    return float(np.clip(longer, 1.0, LONGEST))
