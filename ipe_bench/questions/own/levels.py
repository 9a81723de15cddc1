"""Estimates several levels of the noise from the residuals of many data sets at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, deviations, inverse, multiply, repeated
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.levels import Estimated, satterthwaite
from ipe_bench.real.profiles import CONFIDENCE, half_width

_SCORINGS = 40
"""Steps of Fisher's scoring; constant levels take some five."""
_LONGEST = 1.0
"""The longest step of a level's logarithm."""


class Reported(NamedTuple):
    """Holds what `estimate` makes of answers, beside what they are with the noise known."""

    shift: Array
    """By how much estimates (trials, n) move."""
    width: Array
    """Half-widths (trials, n) of the intervals, in standard errors with the noise known."""


def by_levels(known: Estimated, problem: Problem, x: Array, r: Array) -> Reported:
    """Finds the levels of maximum restricted likelihood for residuals r (trials, m), with the
    slopes of the truth x (n,), by Fisher's scoring from the levels there."""
    levels = known.model.noise
    model = problem.measurement
    h = repeated(model.simulate(x[None])[0], len(r))
    J = model.jacobian(x[None])[0]
    theta = repeated(known.x[model.n :], len(r))
    # An answer that has no readings has no levels either: its interval is left as it is.
    r = np.where(np.isfinite(r).all(axis=1, keepdims=True), r, 0.0)
    for _ in range(_SCORINGS):
        log_sigma, _, L = levels.at(h, theta)
        w = np.exp(-log_sigma)
        slopes = J * w[:, :, None]
        P = inverse(slopes.swapaxes(1, 2) @ slopes)[0]
        shift = multiply(P, multiply(slopes.swapaxes(1, 2), w * r))
        left = w * r - multiply(slopes, shift)
        spare = 1.0 - np.sum((slopes @ P) * slopes, axis=2)
        of_levels = inverse(2.0 * L.swapaxes(1, 2) @ (spare[:, :, None] * L))[0]
        step = multiply(of_levels, multiply(L.swapaxes(1, 2), left**2 - spare))
        theta = theta + np.clip(step, -_LONGEST, _LONGEST)
    freedom = satterthwaite(P, of_levels, slopes, L)
    slopes = problem.R.whiten_jacobian(J)
    before = np.linalg.inv(slopes.T @ slopes)
    scale = deviations(P) / deviations(before)
    return Reported(shift, half_width(CONFIDENCE, freedom) * scale)
