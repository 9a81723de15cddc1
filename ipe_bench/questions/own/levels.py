"""Estimates several levels of the noise from the residuals of many data sets at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, deviations, inverse, multiply, repeated
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.levels import Levels
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
        step = _step(levels, theta, h, J, r).step
        theta = theta + np.clip(step, -_LONGEST, _LONGEST)
    found = _step(levels, theta, h, J, r)
    freedom = satterthwaite(found.P, found.of_levels, found.J, found.L)
    before = problem.R.whiten_jacobian(J)
    scale = deviations(found.P) / deviations(np.linalg.inv(before.T @ before))
    return Reported(found.shift, half_width(CONFIDENCE, freedom) * scale)


class _Step(NamedTuple):
    """Holds a step of the scoring, with what it is made of."""

    step: Array
    """Changes of the levels' logarithms (trials, k)."""
    shift: Array
    P: Array
    """Covariance (trials, n, n) of the parameters."""
    of_levels: Array
    """That of the logarithms (trials, k, k)."""
    J: Array
    """Whitened slopes (trials, m, n)."""
    L: Array
    """Slopes (trials, m, k) of the logarithms of the readings' deviations."""


def _step(levels: Levels, theta: Array, h: Array, J: Array, r: Array) -> _Step:
    """Computes a step at logarithms theta (trials, k) of the levels."""
    log_sigma, _, L = levels.at(h, theta)
    w = np.exp(-log_sigma)
    J = J * w[:, :, None]
    P = inverse(J.swapaxes(1, 2) @ J)[0]
    shift = multiply(P, multiply(J.swapaxes(1, 2), w * r))
    left = w * r - multiply(J, shift)
    spare = 1.0 - np.sum((J @ P) * J, axis=2)
    of_levels = inverse(2.0 * L.swapaxes(1, 2) @ (spare[:, :, None] * L))[0]
    step = multiply(of_levels, multiply(L.swapaxes(1, 2), left**2 - spare))
    return _Step(step, shift, P, of_levels, J, L)
