"""Determines how finely each trial is integrated, by its parameters alone.

A *rung* is a number of equal steps between two readings, and a *place* its index on the ladder 1,
2, 3, 4, 6, 8, ... Rungs n and n/2 are compared (step doubling): d is how far readings and states
move between them, in shares of their tolerances. The error of n/2 is taken as 16 d, that of n as
16 d / (2^8 - 1), which a formula of eighth order leaves; the coarser rung whose error is at most 1
is accepted, and else the trial climbs as far as that formula says. States are compared, too: a
reading that saturates is the same for any state that an unstable step leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask

Indices = NDArray[np.intp]

ORDER = 8
"""Order of the integration formula: half the step leaves 2^-8 of the error."""
SAFETY = 16.0
"""The estimate of an error may be this many times too small."""
STATES = 1e-4
"""Tolerance of the states, as a share of a state's largest magnitude in a trial."""
NOT_FOLLOWED = 1e3
"""Tolerances, of readings and of states, by which the two finest rungs may differ, or two methods:
beyond them the solution is not followed at all."""
_ROUNDING = 1e-12
"""Allowance for rounding errors of a state that should be 0, as a share of the largest state."""
_LARGEST_CLIMB = 4.0
"""A rung grows by no more at once: far from convergence the estimate says nothing."""


def rungs_up_to(finest: float) -> NDArray[np.int64]:
    """Returns the rungs 1, 2, 3, 4, 6, 8, 12, 16, ... up to `finest`, and at least 1, 2."""
    finest = max(finest, 2.0)
    powers = 2 ** np.arange(int(np.log2(finest)) + 1)
    rungs = np.union1d(powers, 3 * powers // 2)
    return rungs[rungs <= finest].astype(np.int64)


def coarser(place: int) -> int:
    """Returns the place on the ladder of half the rung; of 2 for the rung 3, which has no half
    there."""
    return 1 if place == 2 else max(place - 2, 0)


def by_rung(places: Indices, rows: Indices) -> Iterator[tuple[int, Indices]]:
    """Yields the rows at each place, in order."""
    for place in sorted(set(places.tolist())):
        yield place, rows[places == place]


class Found(NamedTuple):
    """Holds what a search found of each trial."""

    places: Indices
    """Accepted places on the ladder (trials,)."""
    computed: Indices
    """Trials whose readings the search has computed."""
    z: Array
    """Their readings (computed, m) at their places."""
    lost: Mask
    """Trials (trials,) that no rung follows."""
    doubtful: Mask
    """Trials (trials,) in which a step at their place was rough, or crossed a pole: that two rungs
    agree proves nothing of them."""


def apart(fine: Array, coarse: Array) -> Array:
    """Computes the distance of states (trials, cases, states, times) from others over the largest
    of each (trials,)."""
    with np.errstate(all="ignore"):
        # The largest gap of a state over all times and cases, over the largest value of that state.
        gap = _largest(fine - coarse)
        sizes = _largest(fine)
        rounding = _ROUNDING * sizes.max(axis=1, keepdims=True, initial=0.0)
        share = np.where(gap == 0.0, 0.0, gap / np.maximum(sizes, rounding))
        return np.nan_to_num(share, nan=np.inf).max(axis=1, initial=0.0)


def shares(gaps: Array, tolerance: Array) -> Array:
    """Returns gaps of readings (trials, m) in shares of their tolerances; 0 where there is none, as
    of an exact reading at the start, whose tolerance may be 0."""
    with np.errstate(all="ignore"):
        return np.where(gaps == 0.0, 0.0, gaps / tolerance)


def _largest(y: Array) -> Array:
    """Returns the largest magnitude (trials, states) over all times and cases."""
    return np.abs(y).max(axis=3).max(axis=1)


@dataclass(frozen=True)
class Asked:
    """Holds what a search asks of a model."""

    rungs: NDArray[np.int64]
    """The ladder."""
    tolerance: Array
    """Tolerances (m,) of the readings."""
    states: tuple[int, ...]
    """Shape of a trial's states, (cases, states, times); a row behind these is held against
    nothing."""
    simulate: Callable[[Indices, int, Array, Array], None]
    """Fills these rows of arrays (trials, m) and (trials, *states) with readings and states at one
    rung."""
    unturned: Callable[[Array, Array], Array]
    """Shifts readings that are angles next to others."""
    in_doubt: Callable[[Array], Mask]
    """Selects trials by their states."""


def search(asked: Asked, start: Indices) -> Found:
    """Finds the coarsest rung at which readings hold their tolerance and states `STATES`.

    The search begins at the places `start` (trials,), 1 at least, and trials climb until they are
    accepted or at the top of the ladder, where they are lost unless they follow the solution.
    """
    climb = _Climb(asked, start)
    computed = np.arange(len(start))
    pending = computed
    while len(pending):
        unsettled = []
        for place, rows in by_rung(climb.tried[pending], pending):
            unsettled.append(climb.tried_at(place, rows))
        pending = np.concatenate(unsettled)
    return Found(climb.found, computed, climb.fine, climb.lost, climb.doubtful)


class _Climb:
    """Holds what a search knows of each trial: readings and states at its rung n and at n/2."""

    def __init__(self, asked: Asked, start: Indices) -> None:
        self.asked = asked
        self.rungs = asked.rungs
        self.top = len(asked.rungs) - 1
        # Where a model states its fastest rate, that bounds the steps: its states are held against
        # nothing, no step is in doubt, and their arrays have no rows.
        self.has_states = asked.states[1] > 0
        self.tried = start.copy()
        """The place of n."""
        self.found = start.copy()
        """The place that is accepted, or would be at the top."""
        trials = len(start)
        self.lost = np.zeros(trials, dtype=bool)
        self.doubtful = np.zeros(trials, dtype=bool)
        readings = (trials, len(asked.tolerance))
        self.fine = np.empty(readings)
        """Readings at n; of a trial that is accepted, those at the place that is found."""
        self.coarse = np.empty(readings)
        self.fine_states = np.empty((trials, *asked.states))
        self.coarse_states = np.empty((trials, *asked.states))
        self.held = np.full(trials, -1)
        """The place whose readings are in `fine`, of trials that climb on."""

    def tried_at(self, place: int, rows: Indices) -> Indices:
        """Tries these trials at a place, and returns those that it does not suffice for."""
        below = coarser(place)
        self._integrate(place, below, rows)
        # Step doubling: d bounds the error of n/2 and, by the order p = 8, d / (2^p - 1) that of n
        # (Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.4).
        coarse_error = self._coarse_error(rows)
        fine_error = coarse_error / ((self.rungs[place] / self.rungs[below]) ** ORDER - 1.0)
        coarse_holds = coarse_error <= 1.0
        fine_holds = (fine_error <= 1.0) | (place == self.top)
        self.found[rows] = np.where(coarse_holds, below, place)
        # These trials are done: from here on `fine` has the readings of the place that is found.
        self.fine[rows[coarse_holds]] = self.coarse[rows[coarse_holds]]
        # At the top a trial is kept though its error exceeds the tolerance, up to `NOT_FOLLOWED`
        # times: rounding shows there, and what finer steps move is what they leave; a stated rate
        # promises the eighth order.
        off = coarse_error / SAFETY if self.has_states else fine_error
        self.lost[rows] = (place == self.top) & (off > NOT_FOLLOWED)
        if self.has_states:
            of_coarse = self.asked.in_doubt(self.coarse_states[rows])
            of_fine = self.asked.in_doubt(self.fine_states[rows])
            self.doubtful[rows] = np.where(coarse_holds, of_coarse, of_fine)
        self.tried[rows] = self._next(place, fine_error)
        return rows[~(coarse_holds | fine_holds)]

    def _integrate(self, place: int, below: int, rows: Indices) -> None:
        """Computes readings and states at n, and at n/2 unless an earlier round computed them."""
        known = self.held[rows] == below
        self.coarse[rows[known]] = self.fine[rows[known]]
        self.coarse_states[rows[known]] = self.fine_states[rows[known]]
        if not known.all():
            self.asked.simulate(
                rows[~known], int(self.rungs[below]), self.coarse, self.coarse_states
            )
        self.asked.simulate(rows, int(self.rungs[place]), self.fine, self.fine_states)
        self.held[rows] = place

    def _coarse_error(self, rows: Indices) -> Array:
        """Computes 16 d, the error of n/2 in readings or in states, whichever is larger in shares
        of its tolerance; not a number, as where an iterate overflows, is infinitely far: such a
        trial climbs to the top, in bounded time."""
        fine = self.fine[rows]
        # The last row behind the states tells of doubts, and is none of them.
        astray = apart(self.fine_states[rows, :, :-1], self.coarse_states[rows, :, :-1])
        with np.errstate(all="ignore"):
            gaps = np.abs(fine - self.asked.unturned(self.coarse[rows], fine))
            shifts = shares(gaps, self.asked.tolerance).max(axis=1)
            error = SAFETY * np.maximum(shifts, astray / STATES)
        return np.nan_to_num(error, nan=np.inf)

    def _next(self, place: int, error: Array) -> Indices:
        """Returns the places to try next, one further at least. The error falls with the p-th power
        of the step: n <- n error^(1/p)."""
        climb = np.minimum(error ** (1.0 / ORDER), _LARGEST_CLIMB)
        wanted = self.rungs[place] * climb
        return np.clip(np.searchsorted(self.rungs, wanted), place + 1, self.top)
