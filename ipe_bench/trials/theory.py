"""Computes the theory of a model at a point: the bounds that no estimator can beat, the contraction
of fixed-point iteration, eq. (15), the curvature of the model, and the bias and the error of least
squares."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import (
    Array,
    Covariance,
    definite_factor,
    deviations,
    finite,
    gram,
    inverse,
    multiply,
    repeated,
    solve,
)
from ipe_bench.estimators.ipe import frozen_covariance
from ipe_bench.estimators.least_squares import inverse_factor
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise

_STEP = 1e-4
"""Step of central differences of the Jacobian, in parameters' sizes or as a share of their
values."""


def linear_bound(problem: Problem) -> Array:
    """Computes standard deviations (n,) of eq. (5): what the linear LSE would reach if h were
    linear."""
    return deviations(frozen_covariance(problem.H_plus[None], problem.R))[0]


def informative_rows(noise: Noise, R: Covariance, J: Array, h: Array) -> Array:
    """Computes rows A (trials, k, n) with A' A the information on the parameters in readings h
    (trials, m) of slopes J (trials, m, n): R^-1/2 J; or, if levels of the noise are to be estimated
    with them, the rows of the normal law's information (Kay, Fundamentals of Statistical Signal
    Processing I, 1993, eq. 3.31), less what the levels explain."""
    known = noise.true_levels(h.shape[1])
    if known is None:
        return R.whiten_jacobian(J)
    levels, theta = known
    of_each = repeated(theta, len(h))
    log, by_h, by_theta = levels.at(h, of_each)
    # The logarithm of a deviation varies with the parameters as the reading h does.
    varying = by_h[:, :, None] * J
    transposed = by_theta.swapaxes(1, 2)
    explained, _ = solve(np.matmul(transposed, by_theta), np.matmul(transposed, varying))
    by_deviation = np.sqrt(2) * (varying - np.matmul(by_theta, explained))
    by_mean = J * np.exp(-log)[:, :, None]
    return np.concatenate([by_mean, by_deviation], axis=1)


def bound_deviations(information: Array, rows: Array) -> Array:
    """Computes standard deviations (trials, n) of the bound whose inverse is `information` A' A
    (trials, n, n), for rows A (trials, k, n); NaN where it is singular.

    An ill-conditioned bound is had from A by QR, since an inverse of A' A loses twice the digits,
    and with them the sign of a variance.
    """
    _, inverse_U, well = definite_factor(information)
    if not well.all():
        inverse_U = put(inverse_U, ~well, inverse_factor(rows[~well]))
    return np.sqrt(np.sum(inverse_U**2, axis=2))


def contraction(J_F: Array) -> tuple[Array, Array, Array]:
    """Computes three measures (trials,) of how much g(x) = x - F(x) contracts, from g' = I - J_F,
    where J_F = H+ J (trials, n, n) and lengths are in multiples of the parameters' units.

    K = n max abs(dg_i/dx_j) of eq. (15): below 1 it is sufficient for the fixed-point theorem, and
    far from necessary. The infinity norm: below 1 in a neighbourhood it is sufficient as well, and
    it is never above K. The spectral radius: below 1 it is necessary and sufficient for local
    convergence, and it is the asymptotic rate.
    """
    slope = np.eye(J_F.shape[1]) - J_F
    bad = ~finite(slope)
    size = np.abs(slope)
    K = slope.shape[1] * size.max(axis=(1, 2))
    norm = size.sum(axis=2).max(axis=1)
    # One matrix that is not finite would make the eigenvalues of all raise.
    eigenvalues = np.linalg.eigvals(np.where(bad[:, None, None], 0.0, slope))
    radius = np.abs(eigenvalues).max(axis=1)
    return K, norm, np.where(bad, np.nan, radius)


def curvature(J: Array, second: Array, H_plus: Array) -> Array:
    """Computes M (trials,) of eq. (23): the largest abs(d2g_i / dx_j dx_k) of Newton's g, where at
    a root d2g = J_F^-1 d2F with J_F = H+ J, from the slopes J (trials, m, n) and second derivatives
    (trials, m, n, n) of the readings, for H+ (1, n, m); NaN where J_F is singular.
    """
    trials, m, n = J.shape
    J_F = np.matmul(H_plus, J)
    second_of_F = np.matmul(H_plus, second.reshape(trials, m, n * n))
    bent, _ = solve(J_F, second_of_F)
    return np.asarray(np.abs(bent).max(axis=(1, 2)))


def second_derivatives(model: Measurement, x: Array) -> Array:
    """Computes d2h/dx_j dx_k (trials, m, n, n) at x (trials, n), by central differences of the
    Jacobian, symmetrised."""
    second = np.stack(list(_bends(model, x)), axis=3)
    return (second + second.swapaxes(2, 3)) / 2


def _bends(model: Measurement, x: Array) -> Iterator[Array]:
    """Yields the derivative (trials, m, n) of the Jacobian by each parameter."""
    step = _STEP * np.maximum(1.0, np.abs(x))
    for k in range(x.shape[1]):
        shift = np.zeros_like(x)
        shift[:, k] = step[:, k]
        change = model.jacobian(x + shift) - model.jacobian(x - shift)
        yield change / (2 * step[:, k])[:, None, None]


def box_bias(J: Array, second: Array, R: Covariance) -> Array:
    """Computes the bias (trials, n) of least squares to second order, from J (trials, m, n) and
    second derivatives.

    -P J' R^-1 t / 2 with P = (J' R^-1 J)^-1 and t_i = tr(P d2h_i) (Box, J. R. Stat. Soc. B 33,
    1971, eq. 2.5).
    """
    Jw = R.whiten_jacobian(J)
    inner = gram(Jw)
    identity = np.broadcast_to(np.eye(J.shape[2]), inner.shape)
    P, _ = solve(inner, identity)
    t = R.whiten(np.einsum("tmij,tij->tm", second, P))
    return -0.5 * multiply(P, multiply(Jw.swapaxes(1, 2), t))


def relative_curvatures(J: Array, second: Array, R: Covariance) -> tuple[Array, Array]:
    """Computes how much the surface of readings bends (intrinsic) and how unevenly the parameters
    run on it (parameter effects): root mean squares over directions, each (trials,), within the 95
    % region of the linear bound.

    Bates and Watts, J. R. Stat. Soc. B 42, 1980: c sqrt(F), where sqrt(chi2_95(n)) stands for
    sqrt(n F), as R is known. The readings deviate from the tangent plane by half as much, relative
    to the region's radius.
    """
    from scipy.special import chdtri

    trials, m, n = J.shape
    Q, U = np.linalg.qr(R.whiten_jacobian(J))
    columns = second.reshape(trials, m, n * n)
    white = R.whiten_jacobian(columns).reshape(trials, m, n, n)
    L, singular = solve(U, np.broadcast_to(np.eye(n), U.shape))
    # Accelerations along the directions in which a step of 1 moves the readings by one deviation.
    from_left = np.matmul(L.swapaxes(1, 2)[:, None], white)
    a = np.matmul(from_left, L[:, None])
    # Their parts in the tangent plane, whose orthonormal basis is Q, and across it.
    along = np.einsum("tmp,tmij->tpij", Q, a)
    across = a - np.einsum("tmp,tpij->tmij", Q, along)
    intrinsic = np.where(singular, np.nan, _mean_square(across))
    of_parameters = np.where(singular, np.nan, _mean_square(along))
    radius = np.sqrt(chdtri(n, 0.05))
    return radius * intrinsic, radius * of_parameters


def _mean_square(a: Array) -> Array:
    """Computes the root mean square (trials,) over unit directions d of |d' a d| for a (trials, p,
    n, n)."""
    n = a.shape[2]
    trace = np.einsum("tpii->tp", a)
    # For symmetric a, the mean of (d' a d)^2 is (2 |a|^2 + tr(a)^2) / (n (n + 2)).
    squares = 2 * np.sum(a**2, axis=(1, 2, 3)) + np.sum(trace**2, axis=1)
    return np.asarray(np.sqrt(squares / (n * (n + 2))))


def misspecified(problem: Problem, h: Array, x: Array, root: Array) -> tuple[Array, Array]:
    """Computes the asymptotic error of least squares under a wrong model, for normal noise and
    error-free readings h (trials, m) of truths x (trials, n): the bias (trials, n), which is that
    of the parameters that come closest to h, and the standard deviation (trials, n) of estimates
    about these; NaN where there is no minimum (Vuong, Caltech working paper 652, 1986; Richmond and
    Horowitz, IEEE Trans. Signal Processing 63, 2015).

    It is known as the misspecified Cramér-Rao bound, but bounds nothing: other estimators may err
    less (Khatib et al., arXiv 2605.20739). Estimates scatter with A^-1 B A^-1, B = J' R^-1 J and A
    = B - sum_i (R^-1 r)_i d2h_i with the residuals r that remain at the minimum.
    """
    found = finite(root)
    deviation = np.full(x.shape, np.nan)
    if found.any():
        deviation[found] = _scatter(problem, h[found], root[found])
    return root - x, deviation


def _scatter(problem: Problem, h: Array, root: Array) -> Array:
    """Computes deviations (trials, n) of A^-1 B A^-1 at the minimum; see `misspecified`."""
    model = problem.measurement
    R = problem.R
    Jw = R.whiten_jacobian(model.jacobian(root))
    r = R.whiten(h - model.near(model.simulate(root), h))
    B = gram(Jw)
    columns = [np.einsum("tmi,tm->ti", R.whiten_jacobian(one), r) for one in _bends(model, root)]
    bent = np.stack(columns, axis=2)
    inverted, _ = inverse(B - (bent + bent.swapaxes(1, 2)) / 2)
    return deviations(np.matmul(np.matmul(inverted, B), inverted))
