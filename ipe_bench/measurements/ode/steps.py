"""How finely each trial is integrated, a pure function of its parameters, and how coarsely its tangents may be.

A level is the number of equal steps between two readings. It is accepted if half of it shows, by step doubling, that it
holds the tolerance on the whole span. Tangents inside iterations may be coarser: a Gauss-Newton step with a Jacobian J~
in place of J leaves |I - J~+ J| of the error that it set out to remove, which is measured at the nominal parameters and
carried over to a trial by its level. Integrating is left to `model`.
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
CONTRACTION = 1e-3
"""The contraction of coarse tangents that is aimed at where it is measured or predicted; elsewhere it may be some times
larger."""
MOST_RK4 = 3
"""Steps of the formula of fourth order, in place of one of eighth order, beyond which it gains nothing."""
_LARGEST_CLIMB = 4.0
"""A level grows by no more at once: far from convergence the estimate says nothing."""
_LONGEST = 5
"""Times that the steps of tangents may be longer than those of the readings."""
_REMEMBERED = 100_000


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
    for place in np.unique(places):
        yield int(place), rows[places == place]


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
        levels, top = self.levels, len(self.levels) - 1
        places, final = start.copy(), start.copy()
        fine, coarse = (np.empty((len(start), len(self.tolerance))) for _ in range(2))
        held = np.full(len(start), -1)  # the place whose readings are in `fine`
        pending = computed = np.flatnonzero(start < top)
        while len(pending):
            still = []
            for place, rows in grouped(places[pending], pending):
                below, known = coarser(place), held[rows] == coarser(place)
                coarse[rows[known]] = fine[rows[known]]
                if not known.all():
                    self.simulate(rows[~known], int(levels[below]), coarse)
                self.simulate(rows, int(levels[place]), fine)
                with np.errstate(all="ignore"):
                    moved = SAFETY * (np.abs(fine[rows] - coarse[rows]) / self.tolerance).max(axis=1)
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


def contraction(coarse: Array, J: Array) -> float:
    """|I - J~+ J| in the spectral norm: what is left of an error after a step with J~ (m, n) in place of J."""
    if not (np.isfinite(coarse).all() and np.isfinite(J).all()):
        return np.inf
    size = np.linalg.norm(J, axis=0)
    size[size == 0] = 1.0
    return float(np.linalg.norm(np.eye(J.shape[1]) - np.linalg.lstsq(coarse / size, J / size, rcond=None)[0], 2))


@dataclass(frozen=True)
class Coarseness:
    """How coarse the tangents of a model may be, as measured at its nominal parameters."""

    rk4: int | None
    """Steps of the formula of fourth order that contract enough at the coarsest level; None: none do."""
    sensitivity: float
    """The contraction factor for each tolerance by which readings are off."""

    def level(self, n: int) -> int:
        """The level for the tangents of a trial at level n: n / 5, or the one that leaves the contraction aimed at, if
        readings at level n are within a sixteenth of the tolerance."""
        affordable = (16 * CONTRACTION / self.sensitivity) ** (1 / ORDER) if self.sensitivity > 0 else np.inf
        return max(1, int(np.ceil(n / np.clip(affordable, 1.0, _LONGEST))))
