"""Stacked linear algebra of small symmetric matrices in which a trial that breaks down turns NaN and disturbs no other.

Sums run in a fixed order along the matrix, so a trial's bits do not depend on the batch that it stands in.
"""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array


def transposed(A: Array) -> Array:
    return A.swapaxes(-1, -2)


def symmetric(P: Array) -> Array:
    """The symmetric part of P (..., n, n)."""
    return 0.5 * (P + transposed(P))


def factor(P: Array) -> Array:
    """The lower Cholesky factors L, L L' = P, of P (..., n, n); NaN from the first pivot that is not positive."""
    L = np.zeros(P.shape)
    for j in range(P.shape[-1]):
        row = L[..., j, :j]
        pivot = P[..., j, j] - np.sum(row * row, axis=-1)
        L[..., j, j] = np.sqrt(np.where(pivot > 0, pivot, np.nan))
        below = P[..., j + 1 :, j] - np.sum(L[..., j + 1 :, :j] * row[..., None, :], axis=-1)
        L[..., j + 1 :, j] = below / L[..., j, j, None]
    return L


def lower_solve(L: Array, B: Array) -> Array:
    """L^-1 B for lower triangular L (..., n, n) and B (..., n, r)."""
    X = np.empty((*np.broadcast_shapes(L.shape[:-2], B.shape[:-2]), *B.shape[-2:]))
    for i in range(L.shape[-1]):
        rest = B[..., i, :] - np.sum(L[..., i, :i, None] * X[..., :i, :], axis=-2)
        X[..., i, :] = rest / L[..., i, i, None]
    return X


def upper_solve(L: Array, B: Array) -> Array:
    """L^-T B for lower triangular L (..., n, n) and B (..., n, r)."""
    return lower_solve(transposed(L)[..., ::-1, ::-1], B[..., ::-1, :])[..., ::-1, :]


def divide(B: Array, P: Array) -> Array:
    """B P^-1 for B (..., r, n) and positive definite P (..., n, n)."""
    L = factor(P)
    return transposed(upper_solve(L, lower_solve(L, transposed(B))))


def mahalanobis(e: Array, P: Array) -> Array:
    """e' P^-1 e (...) for e (..., n) and positive definite P (..., n, n)."""
    return np.sum(lower_solve(factor(P), e[..., None])[..., 0] ** 2, axis=-1)


def root(P: Array) -> Array:
    """A matrix G (n, r) with G G' = P for positive semidefinite P (n, n), of as many columns as P has rank."""
    values, vectors = np.linalg.eigh(symmetric(np.asarray(P, dtype=float)))
    kept = values > len(values) * np.finfo(float).eps * max(values[-1], 0.0)
    return vectors[:, kept] * np.sqrt(values[kept])
