"""Stacked linear algebra of small symmetric matrices in which a trial that breaks down turns NaN
and disturbs no other.

Sums run in a fixed order along the matrix, so a trial's bits do not depend on the batch that it
stands in.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, finite, multiply
from ipe_bench.engine.scan import orthogonalised

_SMALL = 1e-12
"""Pivots, in parts of the variances, below which a covariance counts as singular."""
_ROUND_OFF = 1e-15
"""Eigenvalues of the correlations, over their number, that count as 0."""
_INDEFINITE = 1e-6
"""The eigenvalue below -1e-6 of correlations that are no covariance's."""
_UNLIKE = 1e-14
"""Part of the largest variance below which another is of another kind, as of other units."""
_LOST = 1e-14
"""Pivots, in parts of the deviations, that are round-off in a root of a covariance."""
_OUTSIDE = 1e-6
"""Standard deviations by which a vector may lie outside the range of a covariance."""


def transposed(A: Array) -> Array:
    return A.swapaxes(-1, -2)


def symmetric(P: Array) -> Array:
    """Returns the symmetric part of P (..., n, n)."""
    return 0.5 * (P + transposed(P))


def factor(P: Array) -> Array:
    """Computes the lower Cholesky factors L, L L' = P, of P (..., n, n); NaN from the first pivot
    that is not positive (Golub and Van Loan, Matrix Computations, 2013, algorithm 4.2.1)."""
    L = np.zeros(P.shape)
    n = P.shape[-1]
    for j in range(n):
        # L_ij L_jj = P_ij - sum_{k<j} L_ik L_jk, for the pivot i = j and the rows below it.
        column = P[..., j:, j]
        if j:
            explained = L[..., j:, :j] * L[..., j, None, :j]
            column = column - np.add.reduce(explained, axis=-1)
        pivot = column[..., 0]
        L[..., j, j] = np.sqrt(np.where(pivot > 0, pivot, np.nan))
        if j + 1 < n:
            L[..., j + 1 :, j] = column[..., 1:] / L[..., j, j, None]
    return L


def lower_solve(L: Array, B: Array) -> Array:
    """Computes L^-1 B for lower triangular L (..., n, n) and B (..., n, r)."""
    stack = np.broadcast_shapes(L.shape[:-2], B.shape[:-2])
    X = np.empty((*stack, *B.shape[-2:]))
    for i in range(L.shape[-1]):
        # L_ii x_i = b_i - sum_{k<i} L_ik x_k
        rest = B[..., i, :]
        if i:
            solved = L[..., i, :i, None] * X[..., :i, :]
            rest = rest - np.add.reduce(solved, axis=-2)
        X[..., i, :] = rest / L[..., i, i, None]
    return X


def upper_solve(L: Array, B: Array) -> Array:
    """Computes L^-T B for lower triangular L (..., n, n) and B (..., n, r)."""
    # L' with rows and columns in reverse order is lower triangular.
    reversed_L = transposed(L)[..., ::-1, ::-1]
    return lower_solve(reversed_L, B[..., ::-1, :])[..., ::-1, :]


class Half(NamedTuple):
    """Holds G (..., n, n) with G G' = P for positive semidefinite P (..., n, n), and a generalised
    inverse G^-."""

    G: Array
    L: Array
    """Cholesky factors (..., n, n), which are G where P is regular; NaN elsewhere."""
    inverse: Array
    """G^- (..., n, n) where P is singular."""
    singular: Mask
    """Whether a pivot is as small as round-off (...)."""

    def whitened(self, B: Array) -> Array:
        """Computes B G^-' (..., r, n) for B (..., r, n)."""
        X = transposed(lower_solve(self.L, transposed(B)))
        rows = self.singular
        if rows.any():
            X[rows] = np.matmul(B[rows], transposed(self.inverse[rows]))
        return X


def half(P: Array, L: Array | None = None) -> Half:
    """Computes G, G G' = P, of each positive semidefinite P (..., n, n): Cholesky's, or by the
    eigenvalues of the correlations where a pivot is as small as round-off. Variances of 0 are
    allowed; P that is indefinite gives NaN. L, its Cholesky factors (..., n, n), may be given."""
    L = factor(P) if L is None else L
    pivots = np.diagonal(L, axis1=-2, axis2=-1) ** 2
    variances = np.diagonal(P, axis1=-2, axis2=-1)
    singular = np.asarray(~(pivots > _SMALL * variances).all(axis=-1))
    if not singular.any():
        return Half(L, L, L, singular)  # G^- is not asked for
    G = L.copy()
    inverse = np.zeros(P.shape)
    G[singular], inverse[singular] = principal(P[singular])
    L[singular] = np.nan
    return Half(G, L, inverse, singular)


def triangular(P: Array) -> Array:
    """Computes lower triangular F, F F' = P, of positive semidefinite P (trials, n, n); columns
    whose pivots are 0 are 0, as `over` takes it."""
    parts = half(P)
    rows = parts.singular
    F = parts.G.copy()
    if rows.any():
        G = np.moveaxis(F[rows], 0, -1)
        found = np.zeros(G.shape)
        for i, row in enumerate(orthogonalised([[*row] for row in G], len(G), _LOST)):
            for j in range(i + 1):
                found[i, j] = row[j]
        F[rows] = np.moveaxis(found, -1, 0)
    return F


def over(X: Array, F: Array) -> Array:
    """Computes X F^-1 (trials, r, n) for triangular F (trials, n, n), whose pivots count for
    nothing where they are round-off."""
    n = F.shape[-1]
    pivots = np.diagonal(F, axis1=-2, axis2=-1)
    size = np.linalg.norm(F, axis=-1)
    none = np.abs(pivots) <= _LOST * size
    inverse = np.where(none, 0.0, 1.0) / np.where(none, 1.0, pivots)
    out = np.empty(X.shape)
    for j in reversed(range(n)):
        later = multiply(out[..., j + 1 :], F[..., j + 1 :, j])
        out[..., j] = (X[..., j] - later) * inverse[..., j, None]
    return out


def principal(P: Array) -> tuple[Array, Array]:
    """Computes G and G^- (trials, n, n) of positive semidefinite P (trials, n, n), by the axes of
    its correlations."""
    variances = np.diagonal(P, axis1=-2, axis2=-1)
    deviation = np.sqrt(np.maximum(variances, 0.0))[..., None]
    # P = D C D. What is known exactly has no correlations: its row of C is 0.
    d = np.where(deviation > 0, deviation, 1.0)
    C = P / (d * transposed(d))
    usable = finite(C)
    # C = V diag(size^2) V', of which eigenvalues that are round-off count as 0.
    values, V = np.linalg.eigh(np.where(usable[:, None, None], C, 0.0))
    least = P.shape[-1] * _ROUND_OFF
    size = np.sqrt(np.where(values > least, values, 0.0))[:, None]
    indefinite = values[:, 0] < -_INDEFINITE
    size[~usable | indefinite] = np.nan
    # G = D V diag(size), and G^- = diag(1 / size) V' D^-1 with 0 for 1 / 0.
    G = deviation * V * size
    divisor = np.where(size == 0, np.inf, size)
    return G, transposed(V / divisor / d)


def mahalanobis(e: Array, P: Array, parts: Half | None = None) -> Array:
    """Computes e' P^+ e (trials,) for e (trials, n) and positive semidefinite P (n, n), whose half
    is taken if it is not given; infinite outside the range of P."""
    parts = parts or half(P)
    # One matrix for each trial: a product over all of them has other bits in another batch.
    w = parts.whitened(e[:, None])[:, 0]
    # What no w gives lies outside the range of G.
    missed = np.abs(e - multiply(parts.G, w))
    outside = missed > _OUTSIDE * np.sqrt(np.diagonal(P))
    return np.where(outside.any(axis=-1), np.inf, np.sum(w**2, axis=-1))


def root(P: Array) -> Array:
    """Computes G (n, r) with G G' = P for positive semidefinite P (n, n), of as many columns as P
    has rank."""
    P = symmetric(np.asarray(P, dtype=float))
    variances = np.diagonal(P)
    some = variances[variances > 0]
    if some.size and some.min() < _UNLIKE * some.max():
        # Beside a variance as large as that, eigenvalues of P itself lose the small ones.
        G = principal(P[None])[0][0]
        return G[:, G.any(axis=0)]
    values, V = np.linalg.eigh(P)
    round_off = len(values) * np.finfo(float).eps * max(values[-1], 0.0)
    kept = values > round_off
    return V[:, kept] * np.sqrt(values[kept])
