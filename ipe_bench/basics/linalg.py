"""Computes batched linear algebra, in which no trial's result depends on the other trials of the
batch.

Matrix products are stacked, one per trial: a product over a whole batch would change a trial's bits
with the size of the batch. A singular matrix spoils its own trial only.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
Mask: TypeAlias = NDArray[Any]

# glibc keeps freed memory for the next array up to the size of the largest block that it has mapped
# and freed, at most 32 MB (mallopt(3), M_MMAP_THRESHOLD): fetching the pages of Jacobians anew took
# a fifth of an estimation.
np.empty(31 << 20, np.uint8)

_WELL_CONDITIONED = 1e3
"""The condition of J, its columns scaled, up to which J' J has enough of its digits: nine or
more."""


def own(x: Array) -> Array:
    """Returns the same numbers in the layout of compiled code: contiguous, and not marked as
    read-only."""
    x = np.ascontiguousarray(x, dtype=float)
    return x if x.flags.writeable else x.copy()


def finite(a: Array) -> Mask:
    """Tells which trials (trials,) of a (trials, ...) are finite throughout."""
    inner = tuple(range(1, a.ndim))
    return np.asarray(np.isfinite(a).all(axis=inner))


def finite_or(other: float, a: Array) -> Array:
    """Returns the numbers a (...), and the other number where they are not finite."""
    return np.where(np.isfinite(a), a, other)


def divisors(size: Array) -> Array:
    """Returns the sizes (...), and 1 in place of those that are not above 0: what is divided by
    them stays."""
    return np.where(size > 0, size, 1.0)


def read_only(a: Array) -> Array:
    """Returns a read-only view of the same numbers."""
    view = np.asarray(a).view()
    view.flags.writeable = False
    return view


def unmasked(values: Any) -> Array:
    """Returns an ordinary array of floats, in which masked entries are NaN."""
    return np.asarray(np.ma.asarray(values, dtype=float).filled(np.nan))


def plain_numbers(what: str, values: Any, shape: tuple[int, ...]) -> Array:
    """Returns an ordinary array of floats of this shape, in which masked entries are NaN.

    Raises:
        ValueError: they have another shape, or are no real numbers.
    """
    array = np.ma.asarray(values)  # not np.asarray, which keeps what lies under a mask
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{what} of type {array.dtype}, where numbers belong")
    if array.shape != shape:
        raise ValueError(f"{what} of shape {array.shape}, where {shape} belongs")
    return unmasked(array)


def nearest(z: Array, to: Array, periods: Array | Sequence[float]) -> Array:
    """Shifts z (..., m) by whole periods next to `to` (..., m); a period of 0, or none at all,
    shifts no entry."""
    if not len(periods):
        return z
    period = np.asarray(periods)
    shifts = period > 0
    turns = np.round(np.real(z - to) / np.where(shifts, period, np.inf))
    return z - np.where(shifts, period * turns, 0.0)


def multiply(A: Array, x: Array) -> Array:
    """Computes A x for each trial: A (..., p, q), x (trials, q) -> (trials, p)."""
    return np.matmul(A, x[..., None])[..., 0]


def solve(A: Array, b: Array) -> tuple[Array, Mask]:
    """Solves A x = b for each trial: A (trials, n, n), b (trials, n) or (trials, n, k).

    Returns x, NaN where A is singular or not finite, and the mask (trials,) of those trials.
    """
    columns = b[..., None] if b.ndim == 2 else b
    usable = finite(A) & finite(b)
    x = np.full(columns.shape, np.nan)
    x[usable] = _of_each(np.linalg.solve, A[usable], columns[usable])
    return x.reshape(b.shape), ~finite(x)


def inverse(A: Array) -> tuple[Array, Mask]:
    """Inverts each A (trials, n, n); NaN and flagged where it is singular."""
    return solve(A, np.broadcast_to(np.eye(A.shape[-1]), A.shape))


def _of_each(function: Callable[..., Array], *batches: Array) -> Array:
    """Applies a function of NumPy to each matrix; NaN where it refuses one."""
    try:
        return function(*batches)
    except np.linalg.LinAlgError:
        made = np.full(batches[-1].shape, np.nan)
        for i, matrices in enumerate(zip(*batches, strict=True)):
            with contextlib.suppress(np.linalg.LinAlgError):
                made[i] = function(*matrices)
        return made


def diagonal(A: Array) -> Array:
    """Returns a view (trials, n) of the diagonals of matrices (trials, n, n), to be written
    into."""
    return np.einsum("tii->ti", A)


def deviations(P: Array) -> Array:
    """Returns the standard deviations (trials, n) of the covariances P (trials, n, n)."""
    return np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))


def correlations(P: Array) -> Array:
    """Returns the correlations (trials, n, n) of the covariances P (trials, n, n)."""
    d = deviations(P)
    return P / (d[..., :, None] * d[..., None, :])


def gram(A: Array) -> Array:
    """Computes A' A (trials, n, n) for A (trials, k, n)."""
    return np.matmul(A.swapaxes(-1, -2), A)


def from_root(S: Array) -> Array:
    """Computes the covariance S S' (trials, n, n) of its root S (trials, n, k)."""
    return np.matmul(S, S.swapaxes(-1, -2))


def repeated(a: Array, times: int) -> Array:
    """Returns the same array a (...) so many times, (times, ...)."""
    return np.repeat(a[None], times, axis=0)


def squared(r: Array) -> Array:
    """Computes |r|^2 (trials,) of vectors (trials, k)."""
    return np.einsum("ti,ti->t", r, r)


def quadratic_form(P_inverse: Array, e: Array) -> Array:
    """Computes e' P^-1 e for each trial: P_inverse (..., n, n), e (trials, n) -> (trials,)."""
    return np.einsum("...i,...i->...", e, multiply(P_inverse, e))


@dataclass(frozen=True)
class Covariance:
    """Holds a covariance R of m readings, by the factor that whitens them.

    `factor` is the vector (m,) of standard deviations where readings are independent, else the
    lower Cholesky factor (m, m) of R.
    """

    factor: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "factor", read_only(self.factor))

    @property
    def m(self) -> int:
        return len(self.factor)

    @property
    def deviations(self) -> Array:
        """The standard deviation of each reading (m,)."""
        if self.factor.ndim == 1:
            return self.factor
        return np.sqrt(np.sum(self.factor**2, axis=1))

    def whiten(self, r: Array) -> Array:
        """Computes R^-1/2 r for residuals r (..., m): independent, of unit variance."""
        if self.factor.ndim == 1:
            return r / self.factor
        return multiply(self._inverse_factor(), r)

    def whiten_jacobian(self, J: Array) -> Array:
        """Computes R^-1/2 J for J (..., m, n)."""
        if self.factor.ndim == 1:
            return J / self.factor[:, None]
        return np.matmul(self._inverse_factor(), J)

    def restricted(self, rows: NDArray[np.intp]) -> Covariance:
        """Returns the covariance of some of the readings."""
        if self.factor.ndim == 1:
            return Covariance(self.factor[rows])
        return Covariance(np.linalg.cholesky(self.matrix()[np.ix_(rows, rows)]))

    def matrix(self) -> Array:
        """Computes R itself (m, m)."""
        if self.factor.ndim == 1:
            return np.diag(self.factor**2)
        return self.factor @ self.factor.T

    def inverse(self) -> Array:
        """Computes R^-1 (m, m)."""
        if self.factor.ndim == 1:
            return np.diag(self.factor**-2.0)
        whitener = self._inverse_factor()
        return whitener.T @ whitener

    def coloured(self, w: Array) -> Array:
        """Computes R^1/2 w: white numbers w (..., m) of unit variance as draws of covariance R."""
        return w * self.factor if self.factor.ndim == 1 else multiply(self.factor, w)

    def _inverse_factor(self) -> Array:
        from scipy.linalg import solve_triangular

        return solve_triangular(self.factor, np.eye(self.m), lower=True)


def information(J: Array, R: Covariance) -> Array:
    """Computes the Fisher information J' R^-1 J for J (..., m, n)."""
    with np.errstate(all="ignore"):
        Jw = np.ascontiguousarray(R.whiten_jacobian(J))
        return gram(Jw)


def definite_factor(G: Array) -> tuple[Array, Array, Mask]:
    """Computes U (trials, n, n) with U' U = G of each G = J' J (trials, n, n), its inverse, and the
    mask (trials,) of where J is well enough conditioned for this, a third of the work of QR;
    elsewhere they are not to be used.

    The columns of J are scaled first; what is lost of U is n eps times the condition squared
    (Higham, Accuracy and Stability of Numerical Algorithms, 2002, section 20.4).
    """
    n = G.shape[1]
    with np.errstate(all="ignore"):
        size = np.sqrt(np.diagonal(G, axis1=1, axis2=2))
        scaled = G / (size[:, :, None] * size[:, None, :])
        usable = finite(scaled)
        unit = scaled
        if not usable.all():
            unit = np.where(usable[:, None, None], scaled, np.eye(n))
        L = _of_each(np.linalg.cholesky, unit)
        U = L.swapaxes(1, 2)
        inverse_U = _inverse_of_upper(U)
        condition = np.sqrt(n * (inverse_U**2).sum(axis=(1, 2)))
        well = usable & (condition <= _WELL_CONDITIONED)
        return U * size[:, None, :], inverse_U / size[:, :, None], well


def _inverse_of_upper(U: Array) -> Array:
    """Inverts upper triangular matrices (trials, n, n), by back substitution in all trials at
    once."""
    V = np.zeros(U.shape)
    pivots = np.diagonal(U, axis1=1, axis2=2)
    diagonal(V)[...] = 1.0 / pivots
    for i in reversed(range(U.shape[1] - 1)):
        after = slice(i + 1, None)
        row = np.matmul(U[:, i, None, after], V[:, after])[:, 0]
        V[:, i, after] = row[:, after] / -pivots[:, i, None]
    return V


def pseudo_inverse(H: Array, R: Covariance) -> tuple[Array, Mask]:
    """Computes H+ = (H' R^-1 H)^-1 H' R^-1 for H (trials, m, n): (trials, n, m).

    Flags the trials whose H has not full column rank to working precision; their H+ is NaN.
    """
    Hw = np.ascontiguousarray(R.whiten_jacobian(H))
    _, inverse_U, well = definite_factor(information(H, R))
    with np.errstate(all="ignore"):
        # H+ R^1/2 = U^-1 U^-T Hw'
        projected = np.matmul(inverse_U.swapaxes(1, 2), Hw.swapaxes(1, 2))
        whitened = np.matmul(inverse_U, projected)
    deficient = np.full(len(H), False)
    if not well.all():
        whitened[~well], deficient[~well] = _by_orthogonal_factor(Hw[~well])
    if R.factor.ndim == 1:
        return whitened / R.factor, deficient
    return np.matmul(whitened, R._inverse_factor()), deficient


def _by_orthogonal_factor(H: Array) -> tuple[Array, Mask]:
    """Computes the pseudo-inverse of any H (trials, m, n), and where it has not full column rank,
    whatever the units of its columns."""
    trials, m, n = H.shape
    if m < n:
        return np.full((trials, n, m), np.nan), np.full(trials, True)
    usable = finite(H)
    H = np.where(usable[:, None, None], H, 0.0)
    # Powers of two, which change no digit.
    size = 2.0 ** np.frexp(np.abs(H).max(axis=1))[1]
    Q, U = np.linalg.qr(H / size[:, None])
    diagonal = np.abs(np.diagonal(U, axis1=1, axis2=2))
    floor = np.finfo(float).eps * m * np.linalg.norm(U, axis=(1, 2))
    deficient: Mask = ~usable | (diagonal.min(axis=1) <= floor)
    U = np.where(deficient[:, None, None], np.nan, U)
    return solve(U, Q.swapaxes(1, 2))[0] / size[:, :, None], deficient
