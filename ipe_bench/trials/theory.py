"""What theory says of a model and its estimates at a point: how fixed-point iteration contracts, eq. (15), how the
model bends, how least squares is biased to second order, and what it makes of readings from another model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance, deviations, finite, inverse, multiply, solve
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.problem import Problem
from ipe_bench.trials.roots import Known, least_squares_root

_STEP = 1e-4
"""Of central differences of the Jacobian, in parameters' sizes or as a share of their values."""


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


def second_derivatives(model: Measurement, x: Array) -> Array:
    """d2h/dx_j dx_k at x (trials, n): (trials, m, n, n), by central differences of the Jacobian, symmetrised."""
    step = _STEP * np.maximum(1.0, np.abs(x))
    columns = []
    for k in range(x.shape[1]):
        shift = np.zeros_like(x)
        shift[:, k] = step[:, k]
        rise = model.jacobian(x + shift) - model.jacobian(x - shift)
        columns.append(rise / (2 * step[:, k])[:, None, None])
    second = np.stack(columns, axis=3)
    return (second + second.swapaxes(2, 3)) / 2


def box_bias(J: Array, second: Array, R: Covariance) -> Array:
    """The bias (trials, n) of least squares to second order, from the slopes J (trials, m, n) and second derivatives.

    -P J' R^-1 t / 2 with P = (J' R^-1 J)^-1 and t_i = tr(P d2h_i) (Box, J. R. Stat. Soc. B 33, 1971, eq. 2.5).
    """
    Jw = R.whiten_jacobian(J)
    inner = np.matmul(Jw.swapaxes(1, 2), Jw)
    P = solve(inner, np.broadcast_to(np.eye(J.shape[2]), inner.shape))[0]
    t = R.whiten(np.einsum("tmij,tij->tm", second, P))
    return -0.5 * multiply(P, multiply(Jw.swapaxes(1, 2), t))


def relative_curvatures(J: Array, second: Array, R: Covariance) -> tuple[Array, Array]:
    """How much the surface of readings bends (intrinsic) and how unevenly the parameters run on it (parameter effects):
    root mean squares over directions, each (trials,), within the 95 % region of the linear bound.

    Bates and Watts, J. R. Stat. Soc. B 42, 1980: c sqrt(F), where sqrt(chi2_95(n)) stands for sqrt(n F), as R is known.
    The readings deviate from the tangent plane by half as much, relative to the region's radius.
    """
    trials, m, n = J.shape
    Q, U = np.linalg.qr(R.whiten_jacobian(J))
    white = R.whiten_jacobian(second.reshape(trials, m, n * n)).reshape(trials, m, n, n)
    L, singular = solve(U, np.broadcast_to(np.eye(n), U.shape))
    # Accelerations along the directions in which a step of 1 moves the readings by one deviation.
    a = np.matmul(np.matmul(L.swapaxes(1, 2)[:, None], white), L[:, None])
    along = np.einsum("tmp,tmij->tpij", Q, a)
    across = a - np.einsum("tmp,tpij->tmij", Q, along)
    from scipy.special import chdtri

    radius = np.sqrt(chdtri(n, 0.05))
    found = tuple(radius * np.where(singular, np.nan, _mean_square(part)) for part in (across, along))
    return found[0], found[1]


def _mean_square(a: Array) -> Array:
    """The root mean square (trials,) over unit directions d of |d' a d| for a (trials, p, n, n)."""
    n = a.shape[2]
    trace = np.einsum("tpii->tp", a)
    squares = 2 * np.sum(a**2, axis=(1, 2, 3)) + np.sum(trace**2, axis=1)
    return np.asarray(np.sqrt(squares / (n * (n + 2))))


@dataclass(frozen=True)
class Misspecified:
    """The asymptotic error of least squares under a wrong model, for normal noise, in each trial; NaN where it has no
    minimum (Vuong, Caltech working paper 652, 1986; Richmond and Horowitz, IEEE Trans. Signal Processing 63, 2015).

    It is known as the misspecified Cramér-Rao bound, but bounds nothing: other estimators may err less (Khatib et al.,
    arXiv 2605.20739).
    """

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
