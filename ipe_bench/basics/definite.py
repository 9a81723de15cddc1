"""Cholesky factors of many small matrices, one after another in compiled code: LAPACK takes longer to be called than to
compute them.

`linalg` hands this file to `compiled`, and nobody imports it.
"""

import numpy as np
from numba import njit


@njit(
    "void(float64[:, :, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[::1], float64[:, :, ::1])",
    error_model="numpy",
)
def factor(G, U, inverse_U, size, room):
    """For each G (n, n), scaled to a diagonal of ones: the upper Cholesky factor U, its inverse and the Frobenius norm
    of that inverse, not a number where there is none. U and its inverse are scaled back, and written where they are not
    zero. The last argument is room for three matrices (n, n)."""
    n = G.shape[1]
    L, V, columns = room[0], room[1], room[2, 0]
    for t in range(G.shape[0]):
        for i in range(n):
            columns[i] = np.sqrt(G[t, i, i])
        for i in range(n):
            for j in range(i + 1):
                rest = G[t, i, j] / (columns[i] * columns[j])
                for k in range(j):
                    rest -= L[i, k] * L[j, k]
                L[i, j] = np.sqrt(rest) if i == j else rest / L[j, j]
        squares = 0.0
        for j in range(n):
            V[j, j] = 1.0 / L[j, j]
            squares += V[j, j] * V[j, j]
            for i in range(j + 1, n):
                rest = 0.0
                for k in range(j, i):
                    rest -= L[i, k] * V[j, k]
                V[j, i] = rest / L[i, i]
                squares += V[j, i] * V[j, i]
        size[t] = np.sqrt(squares)
        for i in range(n):
            for j in range(i, n):
                U[t, i, j] = L[j, i] * columns[j]
                inverse_U[t, i, j] = V[i, j] / columns[i]
