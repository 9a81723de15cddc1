"""How finely each trial is integrated: step doubling on a ladder of levels, a pure function of the trial's parameters.

A level is the number of equal steps between two readings. It is accepted where half of it shows that it holds the
tolerance on the whole span. How a trial is integrated at a level is left to `model` and `kernel`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array

Indices = NDArray[np.intp]

ORDER = 8
"""Of the integration formula: half the step leaves 2^-8 of the error."""
SAFETY = 16.0
"""The estimate of an error may be this many times too small."""
_LARGEST_CLIMB = 4.0
"""A level grows by no more at once: far from convergence the estimate says nothing."""
_REMEMBERED = 100_000


def ladder(finest: float) -> NDArray[np.int64]:
    """The levels 1, 2, 3, 4, 6, 8, 12, 16, ... up to `finest`, and at least 1, 2."""
    powers = 2 ** np.arange(int(np.log2(max(finest, 2.0))) + 1)
    levels = np.union1d(powers, 3 * powers // 2)
    return levels[levels <= max(finest, 2.0)].astype(np.int64)


def coarser(place: int) -> int:
    """The place on the ladder of half the level; of 2 for the level 3, which has no half there."""
    return 1 if place == 2 else max(place - 2, 0)


@dataclass(frozen=True)
class Found:
    """Places on the ladder (trials,), and the readings (trials, m) that the search has computed there: those of the
    trials `computed`, in their order."""

    places: Indices
    computed: Indices
    z: Array


@dataclass(frozen=True)
class Search:
    """Finds the coarsest level at which readings hold `tolerance` (m,), by comparing levels n and n/2.

    Where d is how far the readings move between them, n/2 is accepted if 16 d is within the tolerance, n if the error
    that an eighth-order formula then has left, 16 d / (2^8 - 1), is; else n grows as that formula says. Trials that
    do not get there end at the top of the ladder.
    """

    levels: NDArray[np.int64]
    tolerance: Array
    simulate: Callable[[Indices, int, Array], None]
    """Fills these rows of an array (trials, m) with the readings of these trials at one level."""

    def run(self, start: Indices) -> Found:
        """From the places (trials,) where to begin; those at the top are accepted as they are."""
        top = len(self.levels) - 1
        state = _State(start.copy(), start.copy(), np.full(len(start), -1), len(self.tolerance))
        pending = computed = np.flatnonzero(start < top)
        while len(pending):
            still = [self._compare(place, rows, state) for place, rows in grouped(state.places[pending], pending)]
            pending = np.concatenate(still)
        return Found(state.final, computed, state.fine if len(computed) == len(start) else state.fine[computed])

    def _compare(self, place: int, rows: Indices, state: _State) -> Indices:
        """Tries one level for the trials in `rows`; those that are not done, with their next place in `places`."""
        below, top = coarser(place), len(self.levels) - 1
        known = state.held[rows] == below
        state.coarse[rows[known]] = state.fine[rows[known]]
        if not known.all():
            self.simulate(rows[~known], int(self.levels[below]), state.coarse)
        self.simulate(rows, int(self.levels[place]), state.fine)
        with np.errstate(all="ignore"):
            moved = SAFETY * self._distance(state.fine[rows], state.coarse[rows])
            left = moved / ((self.levels[place] / self.levels[below]) ** ORDER - 1.0)
            # Not a number where an iterate overflows: such a trial climbs to the top, in bounded time.
            moved, left = np.nan_to_num(moved, nan=np.inf), np.nan_to_num(left, nan=np.inf)
            wanted = self.levels[place] * np.minimum(left ** (1.0 / ORDER), _LARGEST_CLIMB)
        enough, good = moved <= 1.0, (left <= 1.0) | (place == top)
        state.fine[rows[enough]] = state.coarse[rows[enough]]
        state.final[rows] = np.where(enough, below, place)
        state.held[rows] = place
        state.places[rows] = np.clip(np.searchsorted(self.levels, wanted), place + 1, top)
        return rows[~(enough | good)]

    def _distance(self, fine: Array, coarse: Array) -> Array:
        """The largest difference of each trial (trials,) in tolerances. Overwrites its arguments."""
        np.subtract(fine, coarse, out=fine)
        np.divide(np.abs(fine, out=fine), self.tolerance, out=fine)
        return fine.max(axis=1)


class _State:
    """Where a search stands: for each trial the place to try, the one accepted, the one whose readings are `fine`."""

    def __init__(self, places: Indices, final: Indices, held: Indices, m: int) -> None:
        self.places, self.final, self.held = places, final, held
        self.fine, self.coarse = np.empty((len(places), m)), np.empty((len(places), m))


def grouped(places: Indices, rows: Indices) -> Iterator[tuple[int, Indices]]:
    """The rows at each place, in order."""
    for place in np.unique(places):
        yield int(place), rows[places == place]


class Remembered:
    """Levels of trials met lately, by the bits of their parameters: a simulation and a Jacobian share one search.

    What is forgotten is found again, the same.
    """

    def __init__(self) -> None:
        self._places: dict[bytes, int] = {}

    def look_up(self, x: Array) -> Indices:
        """The places (trials,); -1 where not known."""
        return np.array([self._places.get(key, -1) for key in _bits(x)], dtype=np.intp)

    def keep(self, x: Array, places: Indices) -> None:
        if len(self._places) + len(x) > _REMEMBERED:
            self._places.clear()
        self._places.update(zip(_bits(x), places.tolist(), strict=True))


def _bits(x: Array) -> list[bytes]:
    """Of each trial of x (trials, n)."""
    return np.ascontiguousarray(x).view(f"V{8 * x.shape[1]}").ravel().tolist() if len(x) else []
