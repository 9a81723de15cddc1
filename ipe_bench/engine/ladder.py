"""Determines how finely each trial is integrated, by its parameters alone, and how coarsely its
tangents may be.

A rung is the number of equal steps between two readings. It is accepted if half of it shows, by
step doubling, that it holds the tolerance on the whole span, and that the states converge: a
reading that saturates is the same for any state that an unstable step leaves. Tangents inside
iterations may be coarser: a Gauss-Newton step with a Jacobian J~ in place of J leaves |I - J~+ J|
of the error, measured at the nominal parameters and carried over by the rung.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask

Indices = NDArray[np.intp]

ORDER = 8
"""Order of the integration formula: half the step leaves 2^-8 of the error."""
SAFETY = 16.0
"""The estimate of an error may be this many times too small."""
AIM = 1e-3
"""The contraction of coarse tangents that is aimed at where it is measured or predicted; elsewhere
it may be some times larger."""
MOST_OF_FOURTH = 3
"""Steps of the formula of fourth order, in place of one of eighth order, beyond which it gains
nothing."""
HIGHEST_OF_FOURTH = 2
"""The highest rung at which it is tried: up to here its stages, 4 (rung + 1) at least, are not more
than the 12 of a single step of eighth order."""
LONGEST = 5
"""Times that the steps of tangents may be longer than those of the readings."""
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
    """Holds places on the ladder (trials,), the readings (trials, m) that the search has computed
    there, those of the trials `computed` in their order, and whether a trial is `lost`: no rung
    follows it; and whether it is `doubtful`: a step at its place was rough, or crossed a pole, so
    that agreement of two rungs proves nothing."""

    places: Indices
    computed: Indices
    z: Array
    lost: Mask
    doubtful: Mask


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


def _largest(y: Array) -> Array:
    """Returns the largest magnitude (trials, states) over all times and cases."""
    return np.abs(y).max(axis=3).max(axis=1)


def search(
    rungs: NDArray[np.int64],
    tolerance: Array,
    states: tuple[int, ...],
    simulate: Callable[[Indices, int, Array, Array], None],
    start: Indices,
    unturned: Callable[[Array, Array], Array] = lambda h, z: h,
    in_doubt: Callable[[Array], Mask] = lambda states: np.zeros(len(states), dtype=bool),
) -> Found:
    """Finds the coarsest rung at which readings hold `tolerance` (m,) and states `STATES`; compares
    rungs n and n/2.

    Where d is how far they move between them, n/2 is accepted if 16 d is within the tolerance, n if
    the error that an eighth-order formula then has left, 16 d / (2^8 - 1), is; else n grows as that
    formula says. Trials that do not get there end at the top of the ladder. The search begins at
    the places `start` (trials,), and those at the top are accepted as they are; `simulate` fills
    these rows of arrays (trials, m) and (trials, *states) with readings and states (cases, states,
    times) at one rung, `unturned` shifts readings that are angles next to others, and `in_doubt`
    selects trials by their states; a row behind these is held against nothing.
    """
    top = len(rungs) - 1
    places = start.copy()
    final = start.copy()
    lost, doubtful = np.zeros((2, len(start)), dtype=bool)
    fine, coarse = np.empty((2, len(start), len(tolerance)))
    y, near = np.empty((2, len(start), *states))
    held = np.full(len(start), -1)  # the place whose readings are in `fine`
    pending = computed = np.flatnonzero(start < top)
    # Each round integrates the pending trials at their rung n, and at n/2 where it is not known.
    while len(pending):
        still = []
        for place, rows in by_rung(places[pending], pending):
            below = coarser(place)
            # What an earlier round computed at n/2 serves again.
            known = held[rows] == below
            coarse[rows[known]] = fine[rows[known]]
            near[rows[known]] = y[rows[known]]
            if not known.all():
                simulate(rows[~known], int(rungs[below]), coarse, near)
            simulate(rows, int(rungs[place]), fine, y)
            astray = apart(y[rows, :, :-1], near[rows, :, :-1])
            with np.errstate(all="ignore"):
                gaps = np.abs(fine[rows] - unturned(coarse[rows], fine[rows]))
                shifts = (gaps / tolerance).max(axis=1)
                moved = SAFETY * np.maximum(shifts, astray / STATES)
            # Not a number where an iterate overflows: such a trial climbs to the top, in bounded
            # time.
            moved = np.nan_to_num(moved, nan=np.inf)
            # Step doubling: d bounds the error of n/2 and, by the order p = 8, d / (2^p - 1) that
            # of n (Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section
            # II.4).
            left = moved / ((rungs[place] / rungs[below]) ** ORDER - 1.0)
            enough = moved <= 1.0
            good = (left <= 1.0) | (place == top)
            # n/2 is good enough; or n is; else the trial climbs.
            final[rows] = np.where(enough, below, place)
            fine[rows[enough]] = coarse[rows[enough]]
            # Where rounding shows, what finer steps move is what they leave; a stated rate promises
            # the eighth order.
            off = moved / SAFETY if states[1] else left
            lost[rows] = (place == top) & (off > NOT_FOLLOWED)
            if states[1]:
                doubtful[rows] = np.where(enough, in_doubt(near[rows]), in_doubt(y[rows]))
            held[rows] = place
            # The error falls with the p-th power of the step: n <- n left^(1/p).
            wanted = rungs[place] * np.minimum(left ** (1.0 / ORDER), _LARGEST_CLIMB)
            places[rows] = np.clip(np.searchsorted(rungs, wanted), place + 1, top)
            still.append(rows[~(enough | good)])
        pending = np.concatenate(still)
    return Found(final, computed, fine[computed], lost, doubtful)


def tangent_contraction(coarse: Array, J: Array) -> float:
    """Computes |I - J~+ J| in the spectral norm: the share of an error after a step with J~ (m, n)
    in place of J."""
    if not (np.isfinite(coarse).all() and np.isfinite(J).all()):
        return np.inf
    # Columns are scaled, so that the contraction does not depend on the parameters' units.
    size = np.linalg.norm(J, axis=0)
    size[size == 0] = 1.0
    steps = np.linalg.lstsq(coarse / size, J / size, rcond=None)[0]
    return float(np.linalg.norm(np.eye(J.shape[1]) - steps, 2))


class Coarseness(NamedTuple):
    """Holds how coarse the tangents inside an iteration may be, as measured at the nominal
    parameters."""

    fourth: int | None
    """Steps of the formula of fourth order that contract enough at rung 1; None: none do."""
    longer: float
    """Ratio of the steps of tangents to those of the readings, both by the formula of eighth
    order."""

    def steps(self, rung: int) -> tuple[bool, int]:
        """Returns whether the formula is that of fourth order, and the steps between two readings,
        for trials at this rung; 0 stands for trials whose rung is known without a search."""
        # Eighth order: the steps of the readings, as many times longer as was measured to contract.
        if rung > HIGHEST_OF_FOURTH or self.fourth is None:
            fewer = max(rung, 1) / self.longer
            return False, max(1, int(np.ceil(fewer)))
        # The formula of fourth order loses more by what a trial turns faster than the nominal one:
        # at rung 1 there is 2^4 in hand, at rung 2 it is 3^4.
        return True, self.fourth * (rung + 1 if rung else 1)


def fewest_of_fourth(tangents: Callable[[int], Array], J: Array) -> int | None:
    """Returns the fewest steps k of the formula of fourth order for which tangents(k) (m, n)
    contract enough beside J (m, n), or None."""
    for k in range(1, MOST_OF_FOURTH + 1):
        if tangent_contraction(tangents(k), J) <= AIM:
            return k
    return None


def times_longer(off: Array, coarse: Array, J: Array) -> float:
    """Returns how many times longer than those of the readings the steps of tangents may be, from
    longer ones: `off` (m,) is by how much they change the readings, in tolerances, and `coarse` (m,
    n) is their Jacobian.

    Readings are held to 1/`SAFETY` of the tolerance; the contraction grows with the error, and so
    with the eighth power of the step.
    """
    with np.errstate(all="ignore"):
        sensitivity = tangent_contraction(coarse, J) / off.max()
    if not np.isfinite(sensitivity):
        return 1.0
    # contraction = sensitivity * error, error ~ h^8: the ratio of steps that reaches the aim.
    longer = (SAFETY * AIM / sensitivity) ** (1 / ORDER) if sensitivity > 0 else np.inf
    return float(np.clip(longer, 1.0, LONGEST))
