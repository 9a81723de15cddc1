"""Normal equations of many small problems, one after another in compiled code: LAPACK takes longer to be called than
to solve them.

`linalg` loads this file by its path, as `compiled` has it, and nobody imports it.
"""

import numpy as np
from numba import float64, njit, types, void


def _given(axes):
    """An array that is read, and may be read-only."""
    return types.Array(float64, axes, "C", readonly=True)


@njit(
    void(_given(3), _given(1), _given(2), float64[:, :, ::1], float64[:, ::1]),
    nogil=True,
    cache=True,
    error_model="numpy",
    fastmath={"reassoc", "contract", "nsz"},
)
def equations(J, weights, r, G, gradient):
    """G = A' A and the gradient A' r for each J (m, n) and r (m,), where A is J with its rows times the weights (m,)."""
    m, n = J.shape[1:]
    A = np.empty((n, m))
    for t in range(J.shape[0]):
        for i in range(m):
            for a in range(n):
                A[a, i] = J[t, i, a] * weights[i]
        for a in range(n):
            along = 0.0
            for i in range(m):
                along += A[a, i] * r[t, i]
            gradient[t, a] = along
            # Four columns at a time, which share what they load.
            whole = (a + 1) // 4 * 4
            for b in range(0, whole, 4):
                s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
                for i in range(m):
                    v = A[a, i]
                    s0 += v * A[b, i]
                    s1 += v * A[b + 1, i]
                    s2 += v * A[b + 2, i]
                    s3 += v * A[b + 3, i]
                G[t, a, b], G[t, a, b + 1], G[t, a, b + 2], G[t, a, b + 3] = s0, s1, s2, s3
            for b in range(whole, a + 1):
                s0 = 0.0
                for i in range(m):
                    s0 += A[a, i] * A[b, i]
                G[t, a, b] = s0
        for a in range(n):
            for b in range(a):
                G[t, b, a] = G[t, a, b]


@njit(
    void(_given(3), float64[:, :, ::1], float64[:, :, ::1], float64[::1]),
    nogil=True,
    cache=True,
    error_model="numpy",
)
def factor(G, U, inverse_U, size):
    """For each G (n, n), scaled to a diagonal of ones: the upper Cholesky factor U, its inverse and the Frobenius norm
    of that inverse, not a number where there is none. U and its inverse are scaled back."""
    n = G.shape[1]
    columns = np.empty(n)
    L = np.zeros((n, n))
    V = np.zeros((n, n))
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
