"""Slopes of analytic functions by steps along the imaginary axis, exact to round-off."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array, read_only
from ipe_bench.functions.differences import Rows

_STEP = 1e-100
_AT_ONCE = 16384
"""Bytes of slopes that are computed in a call of the function."""


def by_complex_steps(h: Rows, x: Array) -> Array:
    """Computes dh/dx (rows, m, n) of an analytic function as Im h(x + i eps e_k) / eps (Squire and
    Trapp, SIAM Review 40, 1998): no difference is taken, so that the step may be tiny."""
    rows, n = x.shape
    steps = np.eye(n) * _STEP * 1j
    # A few rows in a call: NumPy multiplies complex numbers with other rounding where it reuses a
    # large temporary array for the product, so in one call of all the bits of each would depend on
    # how many there are. The first row alone tells how many slopes a row has.
    parts: list[Array] = []
    begun = 0
    few = 1
    while begun < rows or not parts:
        points = x[begun : begun + few, None, :] + steps
        moved = np.imag(h(read_only(points.reshape(-1, n))))
        by_number = moved.reshape(len(points), n, moved.shape[-1])
        parts.append(by_number.swapaxes(1, 2))
        begun += few
        row_bytes = max(parts[0][:1].nbytes, 1)
        few = max(1, int(_AT_ONCE / row_bytes))
    return np.ascontiguousarray(np.concatenate(parts)) / _STEP
