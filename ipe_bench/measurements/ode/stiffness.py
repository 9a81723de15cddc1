"""Why readings of differential equations cannot be computed: how small a step they need, when, and if they are stiff.

SciPy's LSODA, which is at home with stiff equations, follows the solution; the step that an explicit formula needs is
read off the eigenvalues of the right-hand side there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ipe_bench.basics.linalg import Array

if TYPE_CHECKING:
    from ipe_bench.measurements.ode.model import OdeMeasurement

_STABLE = 5.0
"""The formula of eighth order is stable to a step of about this over the fastest rate."""
_LOOKED_AT = 200
_MOST_CALLS = 100_000
"""Of the right-hand side in one case, beyond which the solution is taken to end."""
_STIFF = 20.0
"""Times that a rate of decay is faster than the solution changes, from which equations are called stiff."""


def diagnose(model: OdeMeasurement, x: Array, shortest: float) -> str:
    """What hinders the integrator from following the solution at x (n,), whose shortest step that is."""
    p, unit = list(x * model.si_sizes), f" {model.time_unit}".rstrip()
    found = [_follow(model, p, case) for case in range(len(model.cases))]
    fastest, t, slow, ended = max(found, key=lambda one: (one[3] is not None, one[0]))
    if ended is not None:
        return f"the solution itself leaves all numbers near t = {ended:.4g}{unit}"
    needed = _STABLE / fastest if fastest > 0 else np.inf
    if needed >= shortest:
        return f"steps of {shortest:.2g}{unit}, the shortest, are too long for these equations"
    looks = f"; they look stiff: {model.stiff_remedy}" if fastest > _STIFF * slow else ""
    return f"the equations need steps of {needed:.2g}{unit} at t = {t:.4g}, and the shortest is {shortest:.2g}{looks}"


def _follow(model: OdeMeasurement, p: list[float], case: int) -> tuple[float, float, float, float | None]:
    """The fastest rate along the solution, when it is met, how fast the solution changes there, and where it ends too
    soon."""
    from scipy.integrate import solve_ivp

    calls, reached = 0, 0.0
    tables, times = model.tables[:, case].tolist(), np.asarray(model.times)

    def rhs(t: float, y: Array) -> Array:
        nonlocal calls, reached
        calls, reached = calls + 1, t
        if calls > _MOST_CALLS:
            raise ArithmeticError
        c = tables[min(int(np.searchsorted(times, t)), len(tables) - 1)]
        return np.array(model.rhs(t, list(y), p, c), dtype=float)

    start, end = np.array(model.start(p, tables[0]), dtype=float), float(model.times[-1])
    with np.errstate(all="ignore"):
        if not (np.isfinite(start).all() and np.isfinite(rhs(0.0, start)).all()):
            return 0.0, 0.0, 0.0, 0.0
        size = max(1e-3, float(np.abs(start).max()))
        try:
            solved = solve_ivp(rhs, (0.0, end), start, "LSODA", rtol=1e-6, atol=1e-9 * size)
        except ArithmeticError:
            return 0.0, 0.0, 0.0, reached
        finite = np.isfinite(solved.y).all(axis=0)
        if not finite.all() or solved.t[-1] < end:
            return 0.0, 0.0, 0.0, float(solved.t[finite][-1])
        places = np.unique(np.linspace(0, len(solved.t) - 1, _LOOKED_AT).astype(int))
        rates = [_rate(rhs, solved.t[i], solved.y[:, i]) for i in places]
        k = int(np.argmax(rates))
        y, t = solved.y[:, places[k]], float(solved.t[places[k]])
        size = np.abs(solved.y).max(axis=1) + 1e-300
        slow = max(float((np.abs(rhs(t, y)) / size).max()), 1.0 / end if end else 0.0)
    return rates[k], t, slow, None


def _rate(rhs, t: float, y: Array) -> float:
    """The largest eigenvalue, in absolute value, of the right-hand side's derivative by the state."""
    step = 1e-7 * np.maximum(np.abs(y), 1e-3 * max(float(np.abs(y).max()), 1e-9))
    slopes = np.stack([(rhs(t, y + h) - rhs(t, y - h)) / (2 * h.max()) for h in np.diag(step)], axis=1)
    return float(np.abs(np.linalg.eigvals(slopes)).max()) if np.isfinite(slopes).all() else 0.0
