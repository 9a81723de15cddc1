"""Second paths of nearly the same cost, such as the mirror image of a path that ranges leave
open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.basics.statuses import Status
from ipe_bench.states.base import Normal
from ipe_bench.states.damped import Descent, LevenbergMarquardtSmoother
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.trackers import Tracks, filtered
from ipe_bench.states.whole_paths import PathDensity, Settled

_NEAR = 1e-2
"""Standard deviations of the prior about a mirrored start, in those of the prior."""
_WORSE = 10.0
"""Times the cost of the path from the prior's mean that a mirrored path may begin with: others
hardly ever arrive."""
_APART = 3.0
"""Standard deviations of a state beyond which two paths are two; within them the covariance counts
both."""


def mirrored(descent: LevenbergMarquardtSmoother, density: PathDensity, paths: Descent) -> Descent:
    """Finds, for each path, the one that steps lead to from its start mirrored in the prior's mean,
    whose density is the same there; of infinite cost where no steps are tried."""
    model = density.model
    m, P = model.prior
    trials = len(density.z)
    start = Normal(2 * m - paths.at.x[:, 0], np.repeat(_NEAR**2 * P[None], trials, axis=0))
    begun = Descent.of(density, filtered(model, density.z, Taylor(), start=start))
    unread = _unread(density)
    far = ~(begun.at.cost <= _WORSE * unread.cost)
    at = replace(begun.at, cost=np.where(far, np.inf, begun.at.cost))
    calls = begun.calls + unread.calls
    return descent.descended(density, replace(begun, at=at, calls=calls))


def _unread(density: PathDensity) -> Settled:
    """Computes the path without noise from the prior's mean, which no readings have moved."""
    model = density.model
    x = model.prior.mean[None]
    path = [x]
    transitions = 0
    for k in range(model.epochs):
        if model.moves(k):
            x = model.transition_into(k)(x)
            transitions += 1
        path.append(x)
    at = density.settled(np.repeat(np.stack(path, axis=1), len(density.z), axis=0))
    # A trial that is alone pays for these transitions, too.
    return replace(at, calls=at.calls + transitions)


def with_second(density: PathDensity, tracks: Tracks, other: Descent) -> Tracks:
    """Counts other paths, which cost no less, in the covariances of tracks.

    With d from one path to the other and their costs J and J', the other is right with the
    probability

        p' = exp(-J' / 2) / (exp(-J / 2) + exp(-J' / 2)),

    if they are two, and the second moment of the states about the path is P + p' d d'.
    """
    assert tracks.cost is not None
    d = density.model.nearest_state(other.at.x[:, 1:], tracks.mean) - tracks.mean
    found = _two(tracks, d) & (tracks.status == Status.CONVERGED)
    found &= other.status == Status.CONVERGED
    with np.errstate(all="ignore"):
        p = 1 / (1 + np.exp((other.at.cost - tracks.cost) / 2))
    p = np.where(found, p, 0.0)
    d = np.where(found[:, None, None], d, 0.0)
    outer = d[..., :, None] * d[..., None, :]
    covariance = tracks.covariance + p[:, None, None, None] * outer
    return replace(tracks, covariance=covariance, other_p=p, other=tracks.mean + d)


def _two(tracks: Tracks, d: Array) -> Mask:
    """Tells whether paths at a distance d (trials, K, n) are two."""
    variances = np.diagonal(tracks.covariance, axis1=2, axis2=3)
    return np.asarray((d**2 > _APART**2 * variances).any(axis=(1, 2)))
