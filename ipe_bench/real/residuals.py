"""Tests the residuals of one fit: whether they are white, and which readings are outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.trials.whiteness import ljung_box, white_p

OUTLIER_LEVEL = 0.01
"""Chance that good readings of a whole file give an outlier somewhere."""
DRAWS = 1999
"""Simulated fits behind the test of whiteness."""
LEAST_P = 1 / (DRAWS + 1)
"""Its least p, which says only that no simulated fit was as extreme."""
_DRAWS_AT_ONCE = 250
_MANY = 20_000
"""Readings from which on the statistic is taken for chi-square, as a fit hardly changes it."""


def explained(J: Array, R: Covariance) -> Array:
    """An orthonormal basis (m, rank) of the range of R^-1/2 J, for J = dh/dx (m, n): a fit takes it from the noise."""
    Jw = R.whiten_jacobian(J)
    size = np.linalg.norm(Jw, axis=0)
    # Scaled first: the parameters' units must not decide what is singular.
    U, s, _ = np.linalg.svd(Jw / np.where(size > 0, size, 1.0), full_matrices=False)
    return U[:, s > np.finfo(float).eps * max(J.shape) * s.max(initial=0.0)]


def tested(w: Array, Q: Array, R: Covariance) -> tuple[Array, Array]:
    """The statistics (m,) of Baarda's w-test and their variances (m,), of which the first over the second is the
    estimated error of a reading that is taken for an outlier (A testing procedure for use in geodetic networks,
    Netherlands Geodetic Commission, 1968).

    w = R^-1/2 r (m,) are the whitened residuals, Q (m, rank) is the basis of `explained`. The statistics are (R^-1 r)_i
    of correlated readings, and w_i of independent ones. Variances are NaN where the parameters absorb a reading's error
    completely, so that nothing can be said of it.
    """
    if R.factor.ndim == 1:
        statistic, before, taken = w, np.ones(len(w)), np.sum(Q**2, axis=1)
    else:
        A = R.whiten(np.eye(len(w)))  # R^-T/2
        statistic, before, taken = A @ w, np.sum(A**2, axis=1), np.sum((A @ Q) ** 2, axis=1)
    left = before - taken
    return statistic, np.where(left > 1e-9 * before, left, np.nan)


def normalised(w: Array, Q: Array, R: Covariance) -> Array:
    """Residuals (m,) in their own standard deviations, as `tested`: N(0, 1) each if the model and R are right, such as
    r_i / (sigma_i sqrt(1 - leverage_i)) of independent readings."""
    statistic, variance = tested(w, Q, R)
    return statistic / np.sqrt(variance)


def outlier_limit(m: int, significance: float = OUTLIER_LEVEL) -> float:
    """Normalised residuals beyond this are outliers: by chance, one among m readings with probability `significance`
    at most (Bonferroni)."""
    return -float(ndtri(significance / (2 * max(m, 1))))


def whiteness(w: Array, Q: Array, series: NDArray[np.intp], draws: int = DRAWS) -> float:
    """The p of Ljung and Box's test (Biometrika 65, 1978) that successive residuals w (m,), whitened, of one instrument
    do not resemble each other; NaN if they are not finite, or too few to have neighbours or to vary.

    series (channels, length) has the residuals of each instrument in their order, -1 where a reading is missing. Since
    the fit takes the basis Q (m, rank) out of the noise, p is counted among simulated fits of white noise, always the
    same ones (Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 4.2).
    """

    def placed(w: Array) -> Array:
        return np.where(series >= 0, w[:, series], np.nan)

    observed = float(ljung_box(placed(w[None]))[0][0])
    # A single degree of freedom leaves one direction: its residuals differ in size alone, which Q does not see.
    if Q.shape[1] >= len(w) - 1 or not (np.isfinite(w).all() and np.isfinite(observed)):
        return np.nan
    if len(w) > _MANY:
        return float(white_p(placed(w[None]))[0])
    rng = np.random.Generator(np.random.Philox(0))
    as_large = 0
    for start in range(0, draws, _DRAWS_AT_ONCE):
        noise = rng.standard_normal((min(_DRAWS_AT_ONCE, draws - start), len(w)))
        as_large += int(np.sum(ljung_box(placed(noise - (noise @ Q) @ Q.T))[0] >= observed * (1 - 1e-9)))
    return (1 + as_large) / (1 + draws)
