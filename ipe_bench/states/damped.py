"""The iterated smoother of Levenberg and Marquardt, which finds the path of largest posterior
density from far away."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import join, put, take
from ipe_bench.basics.linalg import Array, Mask, multiply
from ipe_bench.basics.options import Count, Positive, Quantile, Share, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.states.algebra import root
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.left_out import leaving_out
from ipe_bench.states.linearisation import Taylor, Unscented
from ipe_bench.states.saddles import at_saddles
from ipe_bench.states.smoothers import path_p, tracks_of, whole
from ipe_bench.states.trackers import Tracker, Tracks, passed
from ipe_bench.states.whole_paths import PathDensity, Settled, Tangents
from ipe_bench.states.widened import widened

_TRIES = 15
"""Dampings that are tried about one path."""
_FACTOR = 10.0
"""The factor between them."""
_ROUND_OFF = 1e-12
"""Part of a cost that counts as round-off."""
_SHARES = (0.5, 0.1)
"""Standard deviations of the prior about further starts, in those of the prior, of one round after
another: the wide ones find more turns, the narrow ones more pendulums."""
_SURE = 0.01
"""Probability of the cost with which the search among draws ends: a path that is hard to find has
neighbours that nearly fit."""
_BACK = 3
"""Rounds that lead back to a path, after which the search for a better one ends."""
ALIKE = 1e-2
"""What costs differ by at most if they are those of one minimum: steps that have converged leave
1e-4."""
_SLOW = 3
"""Damped steps in a row that hardly lower an improbable cost, after which a search ends: of those
that crawled so for 30 steps, one in ten arrived."""
_HARDLY = 0.9
"""Share of the cost above which a step has hardly lowered it."""
_NUMBERS = 2e7
"""Numbers of the covariances of further starts that are held at once."""


@dataclass(frozen=True)
class Descent:
    """Holds the paths of a batch on their way down."""

    damping: Array
    """(trials,)"""
    at: Settled
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]
    calls: Array
    """Evaluations of f and of h (trials,) so far."""
    slow: NDArray[np.int64]
    """Damped steps (trials,) in a row that hardly lowered an improbable cost."""
    tries: NDArray[np.int64]
    """Dampings (trials,) that were too small for the step that is tried."""

    @classmethod
    def of(cls, density: PathDensity, tracks: Tracks) -> Descent:
        """Begins at the paths of a smoother's tracks."""
        at = density.settled(whole(tracks).mean)
        trials = len(at.x)
        running = np.full(trials, Status.RUNNING, np.int8)
        none = np.zeros(trials, np.int64)
        return cls(np.zeros(trials), at, running, none, tracks.calls + at.calls, none, none)

    def beaten(self, other: Descent, rows: NDArray[np.intp]) -> Mask:
        """Tells whether a path of `other`, of the trials `rows`, costs less by more than
        round-off."""
        return other.at.cost < self.at.cost[rows] * (1 - _ROUND_OFF)

    def improved(self, other: Descent, rows: NDArray[np.intp]) -> Descent:
        """Returns these paths with those of `other`, of the trials `rows`, that cost less; both
        have been paid for."""
        better = self.beaten(other, rows)
        calls = self.calls.copy()
        calls[rows] += other.calls
        return replace(put(self, rows[better], take(other, better)), calls=calls)


@dataclass(frozen=True)
class LevenbergMarquardtSmoother(Tracker):
    r"""Damped Gauss-Newton steps to the path of largest posterior density (Särkkä and Svensson,
    ICASSP 2020: LM-IEKS).

    Each step is the exact solution of the model linearised about the last path, in which every
    state is read once more, where it was, with a variance of `scale / damping`. The scale of a
    state is its variance before anything is read, along the first path. The damping is 0 as long as
    steps lower the cost of the path, and grows tenfold where one does not,

    .. math:: J(x) = |x_0 - m_0|^2_{P_0^{-1}} + \sum_k |w_k|^2 + \sum_k |z_k - h(x_k)|^2_{R_k^{-1}}.

    The first path is the smoothed track of the EKF or of the UKF, whichever costs less. At its
    minimum J is chi-square with as many degrees as there are readings. Where it is too large for
    that, or the path may lie at a saddle, the trial begins again at draws of the prior, each
    smoothed by a UKF of half or a tenth of the prior's deviations, from the one that costs least,
    in up to twelve rounds of draws. The covariance is that of the affine model, or where the
    density is not normal a second moment about the path; see `widened`.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> table = ib.run(model, {"lm_ieks": ib.states.LevenbergMarquardtSmoother()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    family: ClassVar[str] = "least squares"
    smooths: ClassVar[bool] = True
    iterations: Count = 30
    """Steps at most from one start."""
    tolerance: Positive = 1e-2
    """A path has converged if its undamped step is shorter than this many of its own standard
    deviations, over all states and epochs together."""
    damping: Positive = 1e-2
    """The first damping of a step that raises the cost."""
    level: Share = 1e-3
    """A trial is lost if so large a cost is less probable than this."""
    starts: Whole = 10
    """Draws of the prior among which a trial that is lost looks for another start."""
    rounds: Whole = 12
    """Rounds of such draws at most."""
    seed: int = 0
    """A trial's draws depend on this and on its readings: on nothing else in the batch."""
    gate: Quantile | None = None
    """A reading counts as missing if its squared distance from the path of all others, divided by
    its variance, lies beyond this quantile of the chi-square with one degree, such as 0.999."""

    def track(self, model: StateModel, z: Array) -> Tracks:
        if self.gate is not None:
            return leaving_out(partial(replace(self, gate=None).track, model), model, z, self.gate)
        density = PathDensity.of(model, z)
        tracks = passed(model, z, Taylor())[0]
        first = Descent.of(density, tracks)
        other = Descent.of(density, passed(model, z, Unscented())[0])
        paths = self.descended(density, first.improved(other, np.arange(len(z))))
        return reported(density, self.restarted(density, paths, tracks.start)[0])[0]

    def restarted(
        self, density: PathDensity, paths: Descent, start: Normal
    ) -> tuple[Descent, NDArray[np.int64]]:
        """Begins improbable paths again in rounds of draws, and those that may lie at a saddle, by
        the start that tangents find. Ends where they are probable or were found three times more,
        and tells which round each path is of (trials,), 0 for one of none."""
        by = np.zeros(len(density.z), np.int64)
        again = np.zeros(len(density.z), np.int64)
        if not self.starts:
            return paths, by
        at_saddle, calls = at_saddles(density, paths.at, start)
        paths = replace(paths, calls=paths.calls + calls)
        rows = np.flatnonzero(self.improbable(density.z, paths.at.misfit) | at_saddle)
        for number in range(self.rounds):
            if not rows.size:
                break
            some = density.subset(rows)
            other = self.descended(some, self.drawn(some, number))
            alike = np.abs(other.at.cost - paths.at.cost[rows]) <= ALIKE
            cost = np.where(alike, np.inf, other.at.cost)
            other = replace(other, at=replace(other.at, cost=cost))
            better = paths.beaten(other, rows)
            by[rows[better]] = 1 + number
            # Where searches from elsewhere lead back, it is the model that does not fit.
            again[rows] = np.where(better, 0, again[rows] + alike)
            paths = paths.improved(other, rows)
            sure = path_p(some.z, paths.at.misfit[rows]) >= _SURE
            rows = rows[~sure & (again[rows] < _BACK)]
        return paths, by

    def improbable(self, z: Array, cost: Array) -> Mask:
        """Tells whether a path costs too much for its readings (trials,); one without a finite cost
        does."""
        return ~(path_p(z, cost) >= self.level)

    def drawn(self, density: PathDensity, number: int = 0) -> Descent:
        """Finds, for each trial, the smoothed UKF of least cost among those that begin at draws of
        the prior; each number of a round has its own draws."""
        model = density.model
        trials = len(density.z)
        m, P = model.prior
        spread = root(P)
        generators = own_generators(self.seed, density.z.reshape(trials, -1))
        drawn = normals(generators, number + 1, self.starts, spread.shape[1])
        draws = m + multiply(spread, drawn[:, -1])
        at_once = max(1, int(_NUMBERS / (self.starts * model.epochs * model.n**2)))
        parts = np.split(np.arange(trials), range(at_once, trials, at_once))
        P = _SHARES[number % len(_SHARES)] ** 2 * P
        return join([self._best(density.subset(rows), draws[rows], P) for rows in parts])

    def _best(self, density: PathDensity, draws: Array, P: Array) -> Descent:
        """Selects the best of those that begin at draws (trials, starts, n) with covariance P."""
        trials, starts, n = draws.shape
        one = density.subset(np.repeat(np.arange(trials), starts))
        start = Normal(draws.reshape(-1, n), np.repeat(P[None], len(one.z), axis=0))
        found = Descent.of(one, passed(one.model, one.z, Unscented(), start=start)[0])
        least = found.at.cost.reshape(trials, starts).argmin(axis=1)
        calls = found.calls.reshape(trials, starts).sum(axis=1)
        return replace(take(found, least + starts * np.arange(trials)), calls=calls)

    def descended(self, density: PathDensity, paths: Descent) -> Descent:
        """Moves the paths down, until each has converged or gets no further.

        In one pass each trial tries one step, of the damping that it has come to: none waits for
        another, and the few that need many steps take as many passes as one of them alone.
        """
        finite = np.isfinite(paths.at.cost)
        status = np.where(finite, paths.status, Status.NONFINITE)
        paths = replace(paths, status=status)
        active = np.flatnonzero(finite)
        if not active.size:
            return paths
        part = take(paths, active)
        some = density.subset(active)
        tangents = some.tangents(part.at)
        scale = some.blind_variances(tangents)
        # A state that is known exactly is not damped.
        weights = 1 / np.where(scale > 0, scale, np.inf)
        slopes = Taylor().calls(density.model.n) * density.model.evaluations
        part.calls[:] += slopes
        while active.size:
            part = self._tried(some, part, tangents, weights)
            running = part.status == Status.RUNNING
            going = running & (part.iterations < self.iterations)
            if not going.all():
                paths = put(paths, active[~going], take(part, ~going))
                active = active[going]
                part = take(part, going)
                tangents = take(tangents, going)
                weights = weights[going]
                some = density.subset(active)
            # A path that has moved is linearised anew.
            moved = np.flatnonzero(part.tries == 0)
            if moved.size:
                new = some.subset(moved).tangents(take(part.at, moved))
                tangents = put(tangents, moved, new)
                part.calls[moved] += slopes
        running = paths.status == Status.RUNNING
        return replace(paths, status=np.where(running, Status.MAX_ITERATIONS, paths.status))

    def _tried(
        self, density: PathDensity, paths: Descent, tangents: Tangents, weights: Array
    ) -> Descent:
        """Returns the paths after one try each: moved by a step that does not raise the cost, or
        else with more damping."""
        damping = paths.damping
        first = paths.tries == 0
        # (Hessian of Gauss and Newton + D) dx = -gradient / 2, with D = damping / scale.
        step = density.step(tangents, paths.at, damping[:, None, None] * weights)
        there = self._converged(density, tangents, paths, step)
        found = density.settled(paths.at.x + step)
        lower = found.cost <= paths.at.cost * (1 + _ROUND_OFF)
        at = put(paths.at, lower, take(found, lower))
        # Damping grows until a step is taken; where the first try was, the next begins with less.
        over = lower | there
        eased = np.where(damping > self.damping, damping / _FACTOR, 0.0)
        raised = np.maximum(_FACTOR * damping, self.damping)
        damping = np.where(over, np.where(first, eased, damping), raised)
        # A search that crawls at an improbable cost hardly ever arrives.
        improbable = self.improbable(density.z, at.misfit)
        hardly = improbable & (damping > 0) & (at.cost > _HARDLY * paths.at.cost)
        slow = np.where(over, np.where(hardly, paths.slow + 1, 0), paths.slow)
        tries = np.where(over, 0, paths.tries + 1)
        stalled = (slow >= _SLOW) | (tries >= _TRIES)
        status = np.where(stalled, Status.STALLED, Status.RUNNING).astype(np.int8)
        status[there] = Status.CONVERGED
        iterations = paths.iterations + (over | stalled)
        return Descent(damping, at, status, iterations, paths.calls + found.calls, slow, tries)

    def _converged(
        self, density: PathDensity, tangents: Tangents, paths: Descent, step: Array
    ) -> Mask:
        """Tells whether the undamped step from a path is short (trials,), at the first try. It is
        longer than a damped one, so that it is asked for only where the latter is short."""
        short = (paths.tries == 0) & (density.size(tangents, step) <= self.tolerance**2)
        rows = np.flatnonzero(short & (paths.damping > 0))
        if rows.size:
            some = density.subset(rows)
            about = take(tangents, rows)
            undamped = some.step(about, take(paths.at, rows))
            short[rows] = some.size(about, undamped) <= self.tolerance**2
        return short


def reported(density: PathDensity, paths: Descent) -> tuple[Tracks, Array]:
    """Returns the tracks of the paths, with covariances that the cost itself widens, and the
    logarithm of the volume (trials,) about each: of its probability over its density."""
    model = density.model
    at = density.settled_exactly(paths.at)
    tangents = density.tangents(at)
    around = widened(density, at, tangents)
    out = tracks_of(density, at, at.x, tangents, around.P)
    out.status = paths.status
    out.iterations = paths.iterations
    of_tangents = Taylor().calls(model.n) * model.evaluations
    out.calls = paths.calls + at.calls + around.calls + of_tangents
    return out, np.log(around.mass) - around.log_determinant / 2
