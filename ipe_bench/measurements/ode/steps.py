"""How finely each trial is integrated, a pure function of its parameters, and how coarsely its tangents may be.

A level is the number of equal steps between two readings. It is accepted if half of it shows, by step doubling, that it
holds the tolerance on the whole span. Tangents inside iterations may be coarser: a Gauss-Newton step with a Jacobian J~
in place of J leaves |I - J~+ J| of the error, measured at the nominal parameters and carried over by the level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array

Indices = NDArray[np.intp]

ORDER = 8
"""Of the integration formula: half the step leaves 2^-8 of the error."""
SAFETY = 16.0
"""The estimate of an error may be this many times too small."""
CONTRACTION = 1e-3
"""The contraction of coarse tangents that is aimed at where it is measured or predicted; elsewhere it may be some times
larger."""
MOST_RK4 = 3
"""Steps of the formula of fourth order, in place of one of eighth order, beyond which it gains nothing."""
LONGEST = 5
"""Times that the steps of tangents may be longer than those of the readings."""
_LARGEST_CLIMB = 4.0
"""A level grows by no more at once: far from convergence the estimate says nothing."""


def ladder(finest: float) -> NDArray[np.int64]:
    """The levels 1, 2, 3, 4, 6, 8, 12, 16, ... up to `finest`, and at least 1, 2."""
    powers = 2 ** np.arange(int(np.log2(max(finest, 2.0))) + 1)
    levels = np.union1d(powers, 3 * powers // 2)
    return levels[levels <= max(finest, 2.0)].astype(np.int64)


def coarser(place: int) -> int:
    """The place on the ladder of half the level; of 2 for the level 3, which has no half there."""
    return 1 if place == 2 else max(place - 2, 0)


def grouped(places: Indices, rows: Indices) -> Iterator[tuple[int, Indices]]:
    """The rows at each place, in order."""
    for place in sorted(set(places.tolist())):
        yield place, rows[places == place]


class Found(NamedTuple):
    """Places on the ladder (trials,), and the readings (trials, m) that the search has computed there: those of the
    trials `computed`, in their order."""

    places: Indices
    computed: Indices
    z: Array


def search(
    levels: NDArray[np.int64], tolerance: Array, simulate: Callable[[Indices, int, Array], None], start: Indices
) -> Found:
    """The coarsest level at which readings hold `tolerance` (m,), by comparing levels n and n/2.

    Where d is how far the readings move between them, n/2 is accepted if 16 d is within the tolerance, n if the error
    that an eighth-order formula then has left, 16 d / (2^8 - 1), is; else n grows as that formula says. Trials that
    do not get there end at the top of the ladder. The search begins at the places `start` (trials,), and those at the
    top are accepted as they are; `simulate` fills these rows of an array (trials, m) with readings at one level.
    """
    places, final, top = start.copy(), start.copy(), len(levels) - 1
    fine, coarse = (np.empty((len(start), len(tolerance))) for _ in range(2))
    held = np.full(len(start), -1)  # the place whose readings are in `fine`
    pending = computed = np.flatnonzero(start < top)
    while len(pending):
        still = []
        for place, rows in grouped(places[pending], pending):
            below, known = coarser(place), held[rows] == coarser(place)
            coarse[rows[known]] = fine[rows[known]]
            if not known.all():
                simulate(rows[~known], int(levels[below]), coarse)
            simulate(rows, int(levels[place]), fine)
            with np.errstate(all="ignore"):
                moved = SAFETY * (np.abs(fine[rows] - coarse[rows]) / tolerance).max(axis=1)
                left = moved / ((levels[place] / levels[below]) ** ORDER - 1.0)
                # Not a number where an iterate overflows: such a trial climbs to the top, in bounded time.
                moved, left = np.nan_to_num(moved, nan=np.inf), np.nan_to_num(left, nan=np.inf)
                wanted = levels[place] * np.minimum(left ** (1.0 / ORDER), _LARGEST_CLIMB)
            enough, good = moved <= 1.0, (left <= 1.0) | (place == top)
            fine[rows[enough]] = coarse[rows[enough]]
            final[rows] = np.where(enough, below, place)
            held[rows] = place
            places[rows] = np.clip(np.searchsorted(levels, wanted), place + 1, top)
            still.append(rows[~(enough | good)])
        pending = np.concatenate(still)
    return Found(final, computed, fine[computed])


def contraction(coarse: Array, J: Array) -> float:
    """|I - J~+ J| in the spectral norm: what is left of an error after a step with J~ (m, n) in place of J."""
    if not (np.isfinite(coarse).all() and np.isfinite(J).all()):
        return np.inf
    size = np.linalg.norm(J, axis=0)
    size[size == 0] = 1.0
    return float(np.linalg.norm(np.eye(J.shape[1]) - np.linalg.lstsq(coarse / size, J / size, rcond=None)[0], 2))
