"""Why readings of differential equations cannot be computed: how small a step they need, when, and if they are stiff.

The implicit method, which is at home with stiff equations, follows the solution; the step that an explicit formula
needs is read off the eigenvalues of the right-hand side there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.ode.rodas import MOST_STEPS, SHAPE, Rodas5P

if TYPE_CHECKING:
    from ipe_bench.measurements.ode.model import OdeMeasurement

_STABLE = 5.0
"""The formula of eighth order is stable to a step of about this over the fastest rate."""


def diagnose(model: OdeMeasurement, x: Array, shortest: float) -> str:
    """What hinders the integrator from following the solution at x (n,), whose shortest step that is."""
    unit = f" {model.time_unit}".rstrip()
    z, work = Rodas5P(model, SHAPE).measured(x[None])
    if not np.isfinite(z).all():
        if work.steps >= MOST_STEPS:
            return f"the solution takes more than {MOST_STEPS} steps, by the implicit method, too"
        return f"the solution itself leaves all numbers near t = {work.reached:.4g}{unit}"
    needed, t = _STABLE / max(work.fastest, 1e-300), work.met
    if needed >= shortest:
        return f"steps of {shortest:.2g}{unit}, the shortest, are too long for these equations"
    looks = f"; they look stiff: {model.stiff_remedy}" if work.explicit > work.steps else ""
    return f"the equations need steps of {needed:.2g}{unit} at t = {t:.4g}, and the shortest is {shortest:.2g}{looks}"
