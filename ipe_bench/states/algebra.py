"""Stacked linear algebra of small symmetric matrices in which a trial that breaks down turns NaN and disturbs no other.

Sums run in a fixed order along the matrix, so a trial's bits do not depend on the batch that it stands in.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, finite

_SMALL, _ROUND_OFF = 1e-12, 1e-15
"""Pivots, in parts of the variances, below which a covariance counts as singular, and eigenvalues of the correlations,
over their number, that count as 0."""
_INDEFINITE = 1e-6
"""The eigenvalue below -1e-6 of correlations that are no covariance's."""
_OUTSIDE = 1e-6
"""Standard deviations by which a vector may lie outside the range of a covariance."""


def transposed(A: Array) -> Array:
    return A.swapaxes(-1, -2)


def symmetric(P: Array) -> Array:
    """The symmetric part of P (..., n, n)."""
    return 0.5 * (P + transposed(P))


def factor(P: Array) -> Array:
    """The lower Cholesky factors L, L L' = P, of P (..., n, n); NaN from the first pivot that is not positive."""
    L = np.zeros(P.shape)
    for j in range(P.shape[-1]):
        column = P[..., j:, j]  # the pivot, and what is below
        if j:
            column = column - np.add.reduce(L[..., j:, :j] * L[..., j, None, :j], axis=-1)
        pivot = column[..., 0]
        L[..., j, j] = np.sqrt(np.where(pivot > 0, pivot, np.nan))
        if j + 1 < P.shape[-1]:
            L[..., j + 1 :, j] = column[..., 1:] / L[..., j, j, None]
    return L


def lower_solve(L: Array, B: Array) -> Array:
    """L^-1 B for lower triangular L (..., n, n) and B (..., n, r)."""
    X = np.empty((*np.broadcast_shapes(L.shape[:-2], B.shape[:-2]), *B.shape[-2:]))
    for i in range(L.shape[-1]):
        rest = B[..., i, :]
        if i:
            rest = rest - np.add.reduce(L[..., i, :i, None] * X[..., :i, :], axis=-2)
        X[..., i, :] = rest / L[..., i, i, None]
    return X


def upper_solve(L: Array, B: Array) -> Array:
    """L^-T B for lower triangular L (..., n, n) and B (..., n, r)."""
    return lower_solve(transposed(L)[..., ::-1, ::-1], B[..., ::-1, :])[..., ::-1, :]


class Half(NamedTuple):
    """Holds G (..., n, n) with G G' = P for positive semidefinite P (..., n, n), and a generalised inverse G^-."""

    G: Array
    L: Array
    """Cholesky factors (..., n, n), which are G where P is regular; NaN elsewhere."""
    inverse: Array
    """G^- (..., n, n) where P is singular."""
    singular: Mask
    """Whether a pivot is as small as round-off (...)."""

    def over(self, B: Array) -> Array:
        """B G^- (..., r, n) for B (..., r, n)."""
        X = transposed(upper_solve(self.L, transposed(B)))
        if self.singular.any():
            X[self.singular] = np.matmul(B[self.singular], self.inverse[self.singular])
        return X

    def whitened(self, B: Array) -> Array:
        """B G^-' (..., r, n) for B (..., r, n)."""
        X = transposed(lower_solve(self.L, transposed(B)))
        if self.singular.any():
            X[self.singular] = np.matmul(B[self.singular], transposed(self.inverse[self.singular]))
        return X


def half(P: Array) -> Half:
    """G (..., n, n), G G' = P, of each positive semidefinite P (..., n, n): Cholesky's, or by the eigenvalues of the
    correlations where a pivot is as small as round-off. Variances of 0 are allowed; P that is indefinite gives NaN."""
    L = factor(P)
    pivots, variances = np.diagonal(L, axis1=-2, axis2=-1) ** 2, np.diagonal(P, axis1=-2, axis2=-1)
    singular = np.asarray(~(pivots > _SMALL * variances).all(axis=-1))
    if not singular.any():
        return Half(L, L, L, singular)  # G^- is not asked for
    G, inverse = L.copy(), np.zeros(P.shape)
    L[singular] = np.nan
    G[singular], inverse[singular] = principal(P[singular])
    return Half(G, L, inverse, singular)


def principal(P: Array) -> tuple[Array, Array]:
    """G and G^- (trials, n, n) of positive semidefinite P (trials, n, n), by the axes of its correlations."""
    deviation = np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1), 0.0))[..., None]
    d = np.where(deviation > 0, deviation, 1.0)
    C = P / (d * transposed(d))
    usable = finite(C)
    values, vectors = np.linalg.eigh(np.where(usable[:, None, None], C, 0.0))
    size = np.sqrt(np.where(values > P.shape[-1] * _ROUND_OFF, values, 0.0))[:, None]
    size[~usable | (values[:, 0] < -_INDEFINITE)] = np.nan
    return deviation * vectors * size, transposed(vectors / np.where(size == 0, np.inf, size) / d)


def mahalanobis(e: Array, P: Array) -> Array:
    """e' P^+ e (trials,) for e (trials, n) and positive semidefinite P (n, n); infinite outside the range of P."""
    parts = half(P)
    w = parts.whitened(e)
    outside = np.abs(e - np.matmul(w, transposed(parts.G))) > _OUTSIDE * np.sqrt(np.diagonal(P))
    return np.where(outside.any(axis=-1), np.inf, np.sum(w**2, axis=-1))


def root(P: Array) -> Array:
    """A matrix G (n, r) with G G' = P for positive semidefinite P (n, n), of as many columns as P has rank."""
    values, vectors = np.linalg.eigh(symmetric(np.asarray(P, dtype=float)))
    kept = values > len(values) * np.finfo(float).eps * max(values[-1], 0.0)
    return vectors[:, kept] * np.sqrt(values[kept])
