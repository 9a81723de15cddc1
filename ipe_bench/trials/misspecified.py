"""What least squares makes of readings from another model than it assumes: where it goes, and how it scatters there.

The asymptotic error of least squares under a wrong model, after Vuong (Cramér-Rao bounds for misspecified models,
Caltech working paper 652, 1986) and Richmond and Horowitz (IEEE Trans. Signal Processing 63, 2015), for normal noise.
It is known as the misspecified Cramér-Rao bound, but bounds nothing: other estimators may err less (Khatib et al.,
arXiv 2605.20739). A richer truth is simulated by others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, deviations, inverse
from ipe_bench.measurements.problem import Problem
from ipe_bench.trials.roots import Known, least_squares_root

_STEP = 1e-4


@dataclass(frozen=True)
class Misspecified:
    """What theory says of least squares under a wrong model, in each trial; NaN where it has no minimum."""

    bias: Array
    """(trials, n): the parameters that come closest to the error-free readings, less the true ones."""
    deviation: Array
    """(trials, n): the standard deviation of estimates about those parameters."""


def misspecified(problem: Problem, h: Array, x: Array, J: Array) -> Misspecified:
    """For the error-free readings h (trials, m) of truths x (trials, n), where the assumed model's slopes are J.

    The pseudo-true parameters minimise |h - h(x)| in the metric of R. About them estimates scatter with A^-1 B A^-1,
    B = J' R^-1 J and A = B - sum_i (R^-1 r)_i d2h_i with the residuals r that remain there.
    """
    root = least_squares_root(problem, h, x, Known(J), prior=None)
    found = np.isfinite(root).all(axis=1)
    bias, deviation = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
    if found.any():
        bias[found] = root[found] - x[found]
        deviation[found] = deviations(_sandwich(problem, h[found], root[found]))
    return Misspecified(bias, deviation)


def _sandwich(problem: Problem, h: Array, x: Array) -> Array:
    model, R = problem.measurement, problem.R
    Jw = R.whiten_jacobian(model.jacobian(x))
    B = np.matmul(Jw.swapaxes(1, 2), Jw)
    r = R.whiten(h - model.simulate(x))
    step = _STEP * np.maximum(1.0, np.abs(x))
    bent = np.empty_like(B)
    for k in range(x.shape[1]):
        shift = np.zeros_like(x)
        shift[:, k] = step[:, k]
        rise = R.whiten_jacobian(model.jacobian(x + shift) - model.jacobian(x - shift))
        bent[:, :, k] = np.einsum("tmi,tm->ti", rise, r) / (2 * step[:, k])[:, None]
    inverted = inverse(B - (bent + bent.swapaxes(1, 2)) / 2)[0]
    return np.matmul(np.matmul(inverted, B), inverted)
