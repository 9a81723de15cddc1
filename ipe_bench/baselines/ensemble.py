"""What the methods share that carry many states for each trial: reading the model at all of them in batched calls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.measurements.counted import CountingModel

POINTS_AT_ONCE = 8192
"""Points of one call of the model: bounds the memory that a large ensemble takes."""


def read_members(model: CountingModel, R: Covariance, x: Array, rows: NDArray[np.intp]) -> Array:
    """Whitened h (trials, members, m) at x (trials, members, n), for the trials `rows` of the model's tally."""
    trials, members, n = x.shape
    counted = CountingModel(model.measurement, model.tally, model.share * members)
    count = min(trials, -(-trials * members // POINTS_AT_ONCE))
    pieces = np.array_split(np.arange(trials), count)
    h = [R.whiten(counted.simulate(x[p].reshape(-1, n), np.repeat(rows[p], members))) for p in pieces]
    # In C order whatever the model returned: BLAS rounds otherwise where the strides are other.
    return np.ascontiguousarray(np.concatenate(h)).reshape(trials, members, -1)
