"""What the paper's theorems ask of the model at a point: how much fixed-point iteration contracts there, eq. (15), and
how much Newton's g bends, eq. (23)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, finite, solve


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


def curvature(J: Array, second: Array, H_plus: Array) -> Array:
    """M of eq. (23): the largest abs(d2 g_i / dx_j dx_k) of Newton's g, where at a root d2g = J_F^-1 d2F, from the
    slopes J (trials, m, n) and second derivatives (trials, m, n, n) of the readings, for H+ (1, n, m). (trials,), NaN
    where J_F is singular.
    """
    trials, m, n = J.shape
    d2F = np.matmul(H_plus, second.reshape(trials, m, n * n))
    bent, _ = solve(np.matmul(H_plus, J), d2F)
    return np.asarray(np.abs(bent).max(axis=(1, 2)))
