"""The default tracker: it goes further only where the readings say that it has to."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import gather, put, take
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Quantile
from ipe_bench.basics.statuses import Status
from ipe_bench.states.base import StateModel
from ipe_bench.states.damped import Descent, LevenbergMarquardtSmoother
from ipe_bench.states.folds import calls, exact_tracks, grid_of, may_fold
from ipe_bench.states.left_out import leaving_out
from ipe_bench.states.linearisation import Taylor, Unscented
from ipe_bench.states.mirrored import in_first_turn, mirrored, ordered, with_second
from ipe_bench.states.trackers import Filter, Tracker, Tracks, passed, smoothed
from ipe_bench.states.whole_paths import PathDensity

EXACT = 0
EXTENDED = 1
UNSCENTED = 2
DAMPED = 3
MIRRORED = 4
AGAIN = 5
"""The stages, as the column `extra_stage` names them: the mirrored start answers after the rounds
of restarts, of which the second one is 6, and so on."""


@dataclass(frozen=True)
class AutoTracker(Tracker):
    """Estimates the path of largest posterior density by as much as each trial needs.

    1. The extended filter and its smoother. 2. Where its innovations are improbable, the unscented
    ones, if their path costs less. 3. Levenberg-Marquardt steps from there. A path that the first
    of them would hardly move, such as that of a linear model, is the answer of the stage that it
    comes from. 4. Where the path at the end is improbable, or may lie at a saddle, as where a
    square is read at 0, rounds of steps from draws of the prior, other ones in each. 5. Steps from
    the start mirrored in the prior's mean, if the model is not affine: of the two paths the more
    probable one is the answer, and the other one stands beside it; see `with_second`.

    Noise that depends on the states leaves no density to descend on: the more likely smoother of
    the two is the answer. A scalar state with process noise whose reading turns back among the
    states that the extended filter predicts, as a square or a sine does, or comes round there, has
    its exact density on a grid instead of all this; see `folded`.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> table = ib.run(model, {"auto": ib.states.AutoTracker()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    family: ClassVar[str] = "least squares"
    smooths: ClassVar[bool] = True
    descent: LevenbergMarquardtSmoother = field(default_factory=LevenbergMarquardtSmoother)
    """The steps, what counts as improbable, and the rounds of draws."""
    gate: Quantile | None = None
    """As that of the steps; on a grid as that of a grid."""

    def hindrance(self, model: StateModel) -> str | None:
        why = Filter().hindrance(model)
        return why if why and grid_of(model) is None else None

    def track(self, model: StateModel, z: Array) -> Tracks:
        tracks, first = passed(model, z, Taylor())
        if may_fold(model):
            tracks.calls += calls(model)
        exact, rows = exact_tracks(model, z, first, gate=self.gate)
        if not rows.size:
            return self._rest(model, z, tracks, first)
        parts = [(rows, self._told(model, exact, tracks.calls[rows]))]
        others = np.setdiff1d(np.arange(len(z)), rows)
        if others.size:
            begun = take(tracks, others), take(first, others)
            parts.append((others, self._rest(model, z[others], *begun)))
        return gather(parts)

    def _told(self, model: StateModel, exact: Tracks, begun: Array) -> Tracks:
        """Returns what the smoother of a grid says of trials, after so many calls (trials,)."""
        trials = len(begun)
        tracks = Tracks.empty(model, trials)
        tracks.mean = exact.mean
        tracks.covariance = exact.covariance
        tracks.calls = begun + exact.calls
        tracks.cost = exact.nis.sum(axis=1)
        tracks.stage = np.full(trials, EXACT)
        tracks.gated = exact.gated
        if not (model.gain_by_state or model.R_by_state):
            tracks.status = np.full(trials, Status.CONVERGED, np.int8)
            tracks.iterations = np.full(trials, model.epochs)
            # The moments of the density count all its paths.
            tracks.other = exact.mean
            tracks.other_p = np.full(trials, np.nan)
        return tracks

    def _rest(self, model: StateModel, z: Array, tracks: Tracks, first: Tracks) -> Tracks:
        """Tracks by paths, without the readings beyond a gate if there is one."""
        if self.gate is None:
            return self._by_paths(model, z, tracks, first)

        def track(z: Array) -> Tracks:
            return self._by_paths(model, z, *passed(model, z, Taylor()))

        return leaving_out(track, model, z, self.gate)

    def _by_paths(self, model: StateModel, z: Array, tracks: Tracks, first: Tracks) -> Tracks:
        """Tracks by paths of largest density, from the smoothed tracks of the first filter."""
        by_state = model.gain_by_state or model.R_by_state
        doubtful = np.flatnonzero(self.descent.improbable(z, first.nis.sum(axis=1)))
        if by_state:
            return self._likelier(model, z, tracks, first, doubtful)
        density = PathDensity.of(model, z)
        paths = Descent.of(density, tracks)
        stage = np.full(len(z), EXTENDED)
        if doubtful.size:
            some = density.subset(doubtful)
            other = Descent.of(some, passed(model, some.z, Unscented())[0])
            stage[doubtful[paths.beaten(other, doubtful)]] = UNSCENTED
            paths = paths.improved(other, doubtful)
        paths = self.descent.descended(density, paths)
        arrived = (paths.status == Status.CONVERGED) & (paths.iterations == 1)
        stage[~arrived] = DAMPED
        paths, by = self.descent.restarted(density, paths, tracks.start)
        stage = np.where(by > 0, AGAIN + by - 1, stage)
        # The path of an affine model has no second one beside it.
        rows = np.flatnonzero(stage >= DAMPED)
        if not rows.size:
            return replace(with_second(density, paths, paths), stage=stage)
        found = take(paths, rows)
        found = in_first_turn(density.subset(rows), found)
        mirror = mirrored(self.descent, density.subset(rows), found)
        found, second, better = ordered(found, mirror)
        stage[rows[better]] = MIRRORED
        paths = put(paths, rows, found)
        tracks = with_second(density, paths, put(paths, rows, second))
        return replace(tracks, stage=stage)

    def _likelier(
        self,
        model: StateModel,
        z: Array,
        tracks: Tracks,
        first: Tracks,
        doubtful: NDArray[np.intp],
    ) -> Tracks:
        """Returns the smoother of the first filter, by tangents, or in doubtful trials that by
        points if its filter is likelier."""
        tracks.lose(np.isnan(first.log_likelihood))
        cost = tracks.cost = first.nis.sum(axis=1)
        stage = tracks.stage = np.full(len(z), EXTENDED)
        if not doubtful.size:
            return tracks
        other, second = smoothed(model, z[doubtful], Unscented())
        tracks.calls[doubtful] += second.calls
        before = first.log_likelihood[doubtful]
        # A filter that breaks down, as at points that have no noise level, is not likelier.
        likelier = np.isnan(before) | (second.log_likelihood > before)
        rows = doubtful[likelier]
        stage[rows] = UNSCENTED
        cost[rows] = second.nis.sum(axis=1)[likelier]
        tracks.mean[rows] = other.mean[likelier]
        tracks.covariance[rows] = other.covariance[likelier]
        for mine, its in zip(tracks.start, other.start, strict=True):
            mine[rows] = its[likelier]
        return tracks
