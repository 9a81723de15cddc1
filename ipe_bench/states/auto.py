"""The default tracker: it goes further only where the readings say that it has to.

A *stage* is a way to an answer; each trial ends at one of those below. The cheap stages, two
Gaussian smoothers, run first, and what their innovations or the cost of their paths say decides
which trials go on. Trials go on alone, so that a batch pays only for those that need it. Of a
scalar state whose readings fold, the exact density on a grid takes the place of all stages.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import gather, put, take
from ipe_bench.basics.linalg import Array, Mask
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
        smooth, filtered = passed(model, z, Taylor())
        if may_fold(model):
            smooth.calls += calls(model)
        exact, rows = exact_tracks(model, z, filtered, gate=self.gate)
        if not rows.size:
            return self._by_paths_within_gate(model, z, smooth, filtered)
        on_grid = rows, self._on_grid(model, exact, smooth.calls[rows])
        others = np.setdiff1d(np.arange(len(z)), rows)
        if not others.size:
            return gather([on_grid])
        found = take(smooth, others), take(filtered, others)
        by_paths = self._by_paths_within_gate(model, z[others], *found)
        return gather([on_grid, (others, by_paths)])

    def _on_grid(self, model: StateModel, exact: Tracks, calls_before: Array) -> Tracks:
        """Returns the tracks of trials whose exact density is known, after so many calls
        (trials,)."""
        trials = len(calls_before)
        tracks = Tracks.empty(model, trials)
        tracks.mean = exact.mean
        tracks.covariance = exact.covariance
        tracks.calls = calls_before + exact.calls
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

    def _by_paths_within_gate(
        self, model: StateModel, z: Array, smooth: Tracks, filtered: Tracks
    ) -> Tracks:
        """Tracks by paths, without the readings beyond a gate if there is one."""
        if self.gate is None:
            return self._by_paths(model, z, smooth, filtered)

        def track(z: Array) -> Tracks:
            return self._by_paths(model, z, *passed(model, z, Taylor()))

        return leaving_out(track, model, z, self.gate)

    def _by_paths(self, model: StateModel, z: Array, smooth: Tracks, filtered: Tracks) -> Tracks:
        """Tracks by paths of largest density, from the tracks of the extended filter and its
        smoother."""
        doubtful = np.flatnonzero(self.descent.improbable(z, filtered.nis.sum(axis=1)))
        if model.gain_by_state or model.R_by_state:
            return self._likelier(model, z, smooth, filtered, doubtful)
        density = PathDensity.of(model, z)
        begun, stage = self._extended_or_unscented(density, smooth, doubtful)
        descended = self.descent.descended(density, begun)
        # A path that the first step hardly moves is the answer of the stage that it comes from.
        unmoved = (descended.status == Status.CONVERGED) & (descended.iterations == 1)
        stage[~unmoved] = DAMPED
        found, draws = self.descent.restarted(density, descended, smooth.start)
        stage = np.where(draws > 0, AGAIN + draws - 1, stage)
        # Paths that did not move, as those of affine models, have no second one beside them.
        moved = np.flatnonzero(stage >= DAMPED)
        if not moved.size:
            return replace(with_second(density, found, found), stage=stage)
        first, second, swapped = self._beside_mirrored(density.subset(moved), take(found, moved))
        stage[moved[swapped]] = MIRRORED
        tracks = with_second(density, put(found, moved, first), put(found, moved, second))
        return replace(tracks, stage=stage)

    def _extended_or_unscented(
        self, density: PathDensity, smooth: Tracks, doubtful: NDArray[np.intp]
    ) -> tuple[Descent, NDArray[np.intp]]:
        """Returns the extended smoother's paths, or in doubtful trials the unscented smoother's
        where these cost less, and the stage of each."""
        extended = Descent.of(density, smooth)
        stage = np.full(len(density.z), EXTENDED)
        if not doubtful.size:
            return extended, stage
        some = density.subset(doubtful)
        unscented = Descent.of(some, passed(density.model, some.z, Unscented())[0])
        stage[doubtful[extended.beaten(unscented, doubtful)]] = UNSCENTED
        return extended.improved(unscented, doubtful), stage

    def _beside_mirrored(
        self, density: PathDensity, paths: Descent
    ) -> tuple[Descent, Descent, Mask]:
        """Returns each path and the one from its mirrored start, the more probable one in front,
        and where that is the mirrored one."""
        paths = in_first_turn(density, paths)
        return ordered(paths, mirrored(self.descent, density, paths))

    def _likelier(
        self,
        model: StateModel,
        z: Array,
        smooth: Tracks,
        filtered: Tracks,
        doubtful: NDArray[np.intp],
    ) -> Tracks:
        """Returns the extended smoother's tracks, or in doubtful trials the unscented smoother's
        where its filter is likelier."""
        smooth.lose(np.isnan(filtered.log_likelihood))
        cost = filtered.nis.sum(axis=1)
        stage = np.full(len(z), EXTENDED)
        if not doubtful.size:
            return replace(smooth, cost=cost, stage=stage)
        unscented, unscented_filter = smoothed(model, z[doubtful], Unscented())
        smooth.calls[doubtful] += unscented_filter.calls
        before = filtered.log_likelihood[doubtful]
        # A filter that breaks down, as at points that have no noise level, is not likelier.
        likelier = np.isnan(before) | (unscented_filter.log_likelihood > before)
        rows = doubtful[likelier]
        stage[rows] = UNSCENTED
        cost[rows] = unscented_filter.nis.sum(axis=1)[likelier]
        smooth.mean[rows] = unscented.mean[likelier]
        smooth.covariance[rows] = unscented.covariance[likelier]
        smooth.start.mean[rows] = unscented.start.mean[likelier]
        smooth.start.covariance[rows] = unscented.start.covariance[likelier]
        return replace(smooth, cost=cost, stage=stage)
