"""Simulates logs like a user's own: whether trackers keep the track from where the log begins, and
whether their error bars hold over the prior, whose intervals they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.questions.own.maths import Claim, Own, Point
from ipe_bench.real.logs import Log, LogTracks
from ipe_bench.real.profiles import CONFIDENCE, half_width
from ipe_bench.report.progress import Shows, counting
from ipe_bench.states.auto import AutoTracker
from ipe_bench.states.base import Paths, beginning_at
from ipe_bench.states.trackers import Tracker
from ipe_bench.trials.paths import PathBlock, StateScenario, track_safely
from ipe_bench.trials.scoring import Columns


def own_log(
    log: Log,
    trackers: Mapping[str, Tracker],
    trials: int,
    seed: int = 0,
    progress: Shows = False,
) -> Own:
    """Simulates logs that begin where this one does, by its smoothed start, and lets `trackers`
    follow them with the model's prior; `progress` shows how far that is.

    Raises:
        UserError: the log has no track from which logs can be simulated.
    """
    track = LogTracks.of(log, "auto", AutoTracker())
    if not track.passes:
        why = track.message or "its innovations do not fit the model"
        raise UserError(
            f"the model does not fit the log ({why}), so logs simulated from it would not be like"
            " yours; see `ipe-bench estimate` with the same words, and mend the model first"
        )
    scenario = StateScenario(log.model, seed)
    tracks, _ = track_safely(AutoTracker(), scenario.assumed, log.z[None])
    starts = np.reshape(tracks.start.mean, (-1, log.model.n))
    start = starts[0]
    paths = beginning_at(log.model, start).draw(0, trials, seed)
    from_start = PathBlock(scenario, 0, _missing_as_in(log, paths))
    drawn = scenario.draw(0, trials)
    from_prior = PathBlock(scenario, 0, _missing_as_in(log, drawn))
    claims = []
    with counting("simulated logs", len(trackers), progress) as begin:
        for label, tracker in trackers.items():
            begin(label)
            estimates, kept = from_start.estimate(tracker)
            _, over_prior = from_prior.estimate(tracker)
            names = from_start.names
            ratio = _ratios(over_prior, names) / half_width(CONFIDENCE, None)
            spent = float(np.median(estimates.simulations))
            seconds = float(np.mean(estimates.seconds))
            claims.append(
                Claim.of(label, "", kept["success"], ratio, names, cost=spent, seconds=seconds)
            )
    values = {}
    for state, value in zip(log.model.states, start, strict=True):
        values[state.name] = float(value * state.size)
    return Own(trials, [Point(values, claims)], "", True, {}, moving=True)


def _missing_as_in(log: Log, paths: Paths) -> Paths:
    """Returns paths with readings missing where the log has none."""
    z = np.where(np.isnan(log.z), np.nan, paths.z)
    return replace(paths, z=z)


def _ratios(columns: Columns, names: list[str]) -> Array:
    """Returns errors over reported deviations (trials, n) at the last epoch; infinite where there
    is no track."""
    error = np.stack([columns[f"error_{name}"] for name in names], axis=1)
    deviation = np.stack([columns[f"deviation_{name}"] for name in names], axis=1)
    with np.errstate(all="ignore"):
        ratio = np.abs(error) / deviation
    return np.where(np.isfinite(ratio), ratio, np.inf)
