"""What the paper's theorems ask of the model at a point: how much fixed-point iteration contracts there, eq. (15), and
how much Newton's g bends, eq. (23)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, finite, solve
from ipe_bench.measurements.base import Measurement


@dataclass(frozen=True)
class Contraction:
    """How much g(x) = x - F(x) contracts at a point, from g' = I - H+ J. Each is (trials,).

    Lengths are in multiples of the parameters' units; K and the infinity norm depend on the units, the radius does not.
    """

    K: Array
    """n max abs(dg_i/dx_j), eq. (15). Below 1 is sufficient for the fixed-point theorem, and far from necessary."""
    infinity_norm: Array
    """Below 1 in a neighbourhood is sufficient as well, and is never above K."""
    spectral_radius: Array
    """Below 1 is necessary and sufficient for local convergence, and is the asymptotic rate."""


def contraction_of(J_F: Array) -> Contraction:
    """The contraction where dF/dx = H+ J is J_F (trials, n, n)."""
    slope = np.eye(J_F.shape[1]) - J_F
    bad = ~finite(slope)
    radius = np.abs(np.linalg.eigvals(np.where(bad[:, None, None], 0.0, slope))).max(axis=1)
    size = np.abs(slope)
    return Contraction(
        K=slope.shape[1] * size.max(axis=(1, 2)),
        infinity_norm=size.sum(axis=2).max(axis=1),
        spectral_radius=np.where(bad, np.nan, radius),
    )


def curvature(model: Measurement, H_plus: Array, x: Array) -> Array:
    """M of eq. (23) at x (trials, n): the largest abs(d2 g_i / dx_j dx_k) of Newton's g, where at a root
    d2g = J_F^-1 d2F, by central differences of J_F = H+ dh/dx, for H+ (1, n, m). (trials,), NaN where J_F is singular.
    """
    trials, n = x.shape
    J_F = np.matmul(H_plus, model.jacobian(x))
    step = 1e-4 * np.maximum(1.0, np.abs(x))
    largest = np.zeros(trials)
    for k in range(n):
        shift = np.zeros((trials, n))
        shift[:, k] = step[:, k]
        rise = np.matmul(H_plus, model.jacobian(x + shift) - model.jacobian(x - shift))
        second = rise / (2 * step[:, k])[:, None, None]  # d2F_i / dx_j dx_k
        for j in range(n):
            bent, _ = solve(J_F, second[:, :, j])
            largest = np.maximum(largest, np.abs(bent).max(axis=1))
    return largest
