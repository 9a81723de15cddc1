"""Where linear theory ends: the bias of least squares to second order, and how much the model bends within its bound.

Both follow from second derivatives of the readings; `bounds` and the Cramér-Rao bound go with first ones.
"""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance, multiply, solve
from ipe_bench.measurements.base import Measurement

_STEP = 1e-4
"""Of central differences of the Jacobian, in parameters' sizes or as a share of their values."""
LINEAR = 0.3
"""A relative curvature below this is small (Bates and Watts, Nonlinear Regression Analysis and Its Applications, 1988,
sec. 7.3: within the 95 % region the model deviates from its tangent by less than about a seventh)."""


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
