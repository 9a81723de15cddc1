"""Second paths of nearly the same cost, such as the mirror image of a path that ranges leave
open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.basics.statuses import Status
from ipe_bench.states.base import Normal
from ipe_bench.states.damped import ALIKE, Descent, LevenbergMarquardtSmoother, reported
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.saddles import led_from
from ipe_bench.states.trackers import Tracks, passed
from ipe_bench.states.whole_paths import PathDensity, Settled

_NEAR = 1e-2
"""Standard deviations of the prior about a mirrored start, in those of the prior."""
_WORSE = 10.0
"""Times the cost of the path from the prior's mean that a mirrored path may begin with: others
hardly ever arrive."""
_EARLY = 4
"""Steps from a mirrored start after which only searches with a prospect go on."""
_HOPELESS = 1.5
"""Times the cost of the first path that a search may have by then: of pendulums those that became a
second path had 1.1 at most, and half of the others more than twice it."""
_SAME = 1.0
"""Squared distance from the first path, in deviations of the path, below which a search is on its
way into it."""
_APART = 3.0
"""Standard deviations of a state beyond which two paths are two; within them the covariance counts
both."""


def mirrored(descent: LevenbergMarquardtSmoother, density: PathDensity, paths: Descent) -> Descent:
    """Finds, for each path, the one that steps lead to from its start mirrored in the prior's mean,
    whose density is the same there; of infinite cost where no steps are tried.

    Of the mirrored start and the one with periodic states half a period further on, each trial
    goes on from the one that costs less: a heading a of ranges has its mirror image at -a, and
    the sine of pi - a is that of a.
    """
    model = density.model
    image = 2 * model.prior.mean - paths.at.x[:, 0]
    begun = _begun(density, image)
    if any(model.state_periods):
        half = np.array(model.state_periods) / 2
        begun = begun.improved(_begun(density, image + half), np.arange(len(image)))
    unread = _unread(density)
    far = ~(begun.at.cost <= _WORSE * unread.cost)
    at = replace(begun.at, cost=np.where(far, np.inf, begun.at.cost))
    begun = replace(begun, at=at, calls=begun.calls + unread.calls)
    few = replace(descent, iterations=min(_EARLY, descent.iterations))
    found = few.descended(density, begun)
    going = found.status == Status.MAX_ITERATIONS
    going &= found.at.cost <= _HOPELESS * paths.at.cost
    rows = np.flatnonzero(going)
    if rows.size:
        some = density.subset(rows)
        first = take(paths.at, rows)
        d = model.nearest_state(found.at.x[rows], first.x) - first.x
        found.calls[rows] += Taylor().calls(model.n) * model.evaluations
        rows = rows[some.size(some.tangents(first), d) > _SAME]
        some = density.subset(rows)
        part = take(found, rows)
        running = np.full(len(rows), Status.RUNNING, np.int8)
        found = put(found, rows, descent.descended(some, replace(part, status=running)))
    return in_first_turn(density, found)


def _begun(density: PathDensity, x: Array) -> Descent:
    """Begins at the smoothed paths of extended filters from the starts x (trials, n)."""
    P = _NEAR**2 * density.model.prior.covariance
    start = Normal(x, np.repeat(P[None], len(x), axis=0))
    tracks, _ = passed(density.model, density.z, Taylor(), start=start)
    return Descent.of(density, tracks)


def in_first_turn(density: PathDensity, paths: Descent) -> Descent:
    """Moves paths by whole periods of their states to where the prior is largest, unless they cost
    more there."""
    model = density.model
    if not any(model.state_periods):
        return paths
    periods = np.array(model.state_periods)
    away = paths.at.x[:, 0] - model.prior.mean
    turns = np.where(periods > 0, np.round(away / np.where(periods > 0, periods, 1.0)), 0.0)
    rows = np.flatnonzero(np.isfinite(paths.at.cost) & (turns != 0).any(axis=1))
    if not rows.size:
        return paths
    shift = (periods * turns)[rows]
    moved = density.subset(rows).settled(paths.at.x[rows] - shift[:, None])
    calls = paths.calls.copy()
    calls[rows] += moved.calls
    lower = moved.cost < paths.at.cost[rows]
    at = put(paths.at, rows[lower], take(moved, lower))
    return replace(paths, at=at, calls=calls)


def ordered(paths: Descent, other: Descent) -> tuple[Descent, Descent, Mask]:
    """Orders two paths of each trial by cost, and tells where the second one is the better."""
    better = other.at.cost < paths.at.cost - ALIKE
    rows = np.flatnonzero(better)
    calls = paths.calls + other.calls
    first = put(paths, rows, take(other, rows))
    second = put(other, rows, take(paths, rows))
    return replace(first, calls=calls), second, better


def _unread(density: PathDensity) -> Settled:
    """Computes the path without noise from the prior's mean, which no readings have moved."""
    model = density.model
    still = np.zeros((1, model.epochs, model.n))
    x = led_from(model, model.prior.mean[None], still)
    at = density.settled(np.repeat(x, len(density.z), axis=0))
    # A trial that is alone pays for these transitions, too.
    return replace(at, calls=at.calls + model.evaluations - model.epochs)


def with_second(density: PathDensity, paths: Descent, other: Descent) -> Tracks:
    """Returns the tracks of paths, with other paths, which cost no less, counted in their
    covariances.

    With their costs J and J', the Hessians H and H' of J / 2, and c and c' as `widened` finds them
    where a density is not normal, the other is right with the probability

        p' = w' / (w + w'),   w = exp(-J / 2) (det H)^-1/2 c,

    if they are two (Laplace's approximation). With d from one path to the other, the second moment
    of the states about the path is (1 - p') P + p' (P' + d d'). Half a period away, d is as often
    one way round as the other.
    """
    tracks, volume = reported(density, paths)
    d = density.model.nearest_state(other.at.x[:, 1:], tracks.mean) - tracks.mean
    found = _two(tracks, d) & (tracks.status == Status.CONVERGED)
    rows = np.flatnonzero(found & (other.status == Status.CONVERGED))
    p = np.zeros(len(d))
    apart = np.zeros_like(d)
    if rows.size:
        some = density.subset(rows)
        there = take(other, rows)
        second, volume_there = reported(some, there)
        apart[rows] = d[rows]
        lead = there.at.cost - paths.at.cost[rows] - 2 * (volume_there - volume[rows])
        with np.errstate(over="ignore"):
            p[rows] = 1 / (1 + np.exp(lead / 2))
        moment = second.covariance.copy()
        for share, way in _ways_round(some, second.covariance, d[rows]):
            moment += share[..., None, None] * way[..., :, None] * way[..., None, :]
        of_other = p[rows, None, None, None]
        tracks.covariance[rows] = (1 - of_other) * tracks.covariance[rows] + of_other * moment
        tracks.calls[rows] += second.calls - there.calls
    return replace(tracks, other_p=p, other=tracks.mean + apart)


def _ways_round(density: PathDensity, covariance: Array, d: Array) -> list[tuple[Array, Array]]:
    """Lists the distances at which states lie that are normal about d (trials, K, n), each taken
    the shorter way round its period, with their shares (trials, K)."""
    from scipy.special import ndtr

    ways = [(np.ones(d.shape[:2]), d)]
    for i, period in enumerate(density.model.state_periods):
        if not period:
            continue
        beyond = np.abs(d[..., i]) - period / 2
        with np.errstate(all="ignore"):
            over = np.nan_to_num(ndtr(beyond / np.sqrt(covariance[..., i, i])))
        back = np.zeros_like(d)
        back[..., i] = np.copysign(period, d[..., i])
        here = [(share * (1 - over), way) for share, way in ways]
        there = [(share * over, way - back) for share, way in ways]
        ways = here + there
    return ways


def _two(tracks: Tracks, d: Array) -> Mask:
    """Tells whether paths at a distance d (trials, K, n) are two."""
    variances = np.diagonal(tracks.covariance, axis1=2, axis2=3)
    return np.asarray((d**2 > _APART**2 * variances).any(axis=(1, 2)))
