"""How much the fixed-point iteration contracts at a point, eq. (15)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, finite
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Contraction:
    """How much g(x) = x - F(x) contracts at a point, from g' = I - H+ J. Each is (trials,)."""

    K: Array
    """n max abs(dg_i/dx_j), eq. (15). Below 1 is sufficient for the fixed-point theorem, and far from necessary."""
    infinity_norm: Array
    """Below 1 in a neighbourhood is sufficient as well, and is never above K."""
    spectral_radius: Array
    """Below 1 is necessary and sufficient for local convergence, and is the asymptotic rate."""


def contraction(problem: Problem, x: Array) -> Contraction:
    """The contraction of the fixed-point iteration at x (trials, n): at the truth, the start or the estimate.

    Lengths are in multiples of the parameters' units; K and the infinity norm depend on the units, the radius does not.
    """
    z = np.zeros((len(x), problem.measurement.m))
    return contraction_of(FrozenSystem.at_nominal(problem, z).J(x))


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
