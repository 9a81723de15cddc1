"""Normal equations of many small problems, one after another in compiled code: LAPACK takes longer to be called than to
compute them.

`linalg` hands this file to `compiled`, and nobody imports it.
"""

from numba import njit


@njit(
    "void(float64[:, :, ::1], float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1])",
    error_model="numpy",
    fastmath={"reassoc", "contract", "nsz"},
)
def equations(J, weights, r, G, gradient, A):
    """G = A' A and the gradient A' r for each J (m, n) and r (m,), where A is J with its rows times the weights (m,);
    the last argument is room for A' (n, m)."""
    m, n = J.shape[1:]
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
