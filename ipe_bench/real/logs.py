"""Tracks real readings: trackers follow the states of a model through a log, and find the constants
of the model under which the log is most likely (Schweppe, IEEE Trans. Information Theory 11, 1965).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache, cached_property
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import bdtrc, chdtr, chdtrc, chdtri, ndtri

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array, Mask, deviations
from ipe_bench.basics.options import Finite, NonNegative, Positive, option_types
from ipe_bench.basics.statuses import Status
from ipe_bench.real.readings import TextTable, given_readings, read_tables, unit_of
from ipe_bench.real.residuals import OUTLIER_LEVEL
from ipe_bench.runs.run import validate
from ipe_bench.states.base import StateModel, require_parts
from ipe_bench.states.copies import SURE
from ipe_bench.states.formulas import Formulas, RecordedFormulas
from ipe_bench.states.left_out import MOST_LEFT_OUT, Expected
from ipe_bench.states.lost import why_lost
from ipe_bench.states.particles import Bootstrap
from ipe_bench.states.redone import unchanged
from ipe_bench.states.smoothers import Smoother
from ipe_bench.states.trackers import Tracker, Tracks
from ipe_bench.statistics.intervals import mean_limits
from ipe_bench.statistics.verdicts import (
    COLLAPSED,
    CONSISTENT,
    LOST,
    NO_MAXIMUM,
    NO_VERDICT,
    OVERCONFIDENT,
    SEVERAL_MAXIMA,
    TOO_CAUTIOUS,
    WRONG,
)
from ipe_bench.trials.paths import REDONE, StateScenario, track_safely
from ipe_bench.trials.thresholds import FIT_LEVEL, GATE
from ipe_bench.trials.whiteness import white_p

_SAME_TIME = 1e-3
"""Part of the shortest step by which a time of a log may differ from that of its epoch."""
_KEYS = ("constants", "noise", "deviation")
"""The numbers of a model by formulas that can be found; the latter two are positive, and found by
their logarithms."""
_POSITIVE = (Positive, NonNegative)
"""Types of options of a model in Python that are found by their logarithms."""
_FAR_BELOW = 10.0
"""By how much more than a tenth of the number of readings a log likelihood lies far below the
largest of the log."""
_MOST_OUTLIERS = 5
_MOST_GATED_SHOWN = 10
_HARDLY = 0.1
"""Weight below which a reading hardly counts."""
_LEAST_LOST = 4
"""Epochs beyond the gate, or all, from which on a track may be lost."""
_FEW = 3
_SHARE = 0.05
"""Share of outliers above which the model is wrong, and no list of epochs helps."""
_MOST_OUTLYING = 0.2
"""Share of outliers above which no gate helps either."""
_COLLAPSED = 2.0
"""Effective sample sizes below this have no covariance."""
_TURNS = {"deg": 360.0, "°": 360.0, "rad": 2 * np.pi}
"""Whole turns in the units of angles."""
SEARCHES = 4
"""Searches for a maximum of the likelihood: from the values of the model, and from draws about
them."""
_ALIKE = 2.0
"""Log likelihood by which one maximum has to exceed another: two constants of a 95 % interval
differ by 1.92."""
_STEP = 0.02
"""Step of differences, in standard errors."""
EVALUATIONS = 500
"""Evaluations of the likelihood in one search at most."""
_OF_SIMPLEX = 300
"""Those in its first part."""
_ROUNDS = 20
"""Newton steps at most behind the search."""
_DONE = 1e-8
"""The squared step, in standard errors, that ends them."""
_FAR = 30.0
"""Logarithms of factors beyond which nothing is looked for."""
_NEAR_ZERO = 7.0
"""What is subtracted from the logarithm of a deviation that stands for 0, where a model has no
likelihood at 0."""
_CERTAIN = 0.25
"""A deviation whose logarithm has a smaller standard error is not tried at 0, and has an interval
by that error."""
_EFFECT = 1e-3
"""A change of the log likelihood by more than this is an effect."""
_LOST = float(ndtri(0.975)) ** 2 / 2
"""Log likelihood that is lost at the ends of a 95 % interval: twice that is chi-square with a
degree. For a deviation that is held at 0, a loss of 1.35 would do in 95 % of all logs (Self and
Liang, J. American Statistical Association 82, 1987), since all its misses are where it is held."""
_VAGUE = 20.0
"""Their standard errors where there is no maximum: at 0 a cost is larger by less than `_EFFECT`."""


@dataclass(frozen=True)
class Log:
    """Holds the readings of a model's epochs."""

    model: StateModel
    """The model with an epoch per row of the file, and with the inputs of the file if it is written
    in formulas."""
    z: Array
    """(K, m); NaN where a reading is missing."""
    file: tuple[str, str] | None = None
    """The file with the SHA-256 of the bytes that were read."""

    @classmethod
    def of(
        cls, model: StateModel, readings: Path | Array | None, ignored: Sequence[str] = ()
    ) -> Log:
        """Reads a CSV or Parquet file without the columns `ignored`, an array z (K, m), or the
        readings that come with the model.

        Raises:
            UserError: they are not readings of this model.
        """
        if isinstance(readings, Path):
            return _read(read_tables([readings], ignored)[0], model)
        if readings is None and not isinstance(model, RecordedFormulas):
            raise UserError(
                "readings: is not given; write readings=FILE, with the columns"
                f" {','.join(_wanted(model))}"
            )
        z = model.draw(0, 1).z[0] if readings is None else readings
        shape = (model.epochs, len(model.reading_names))
        if z.shape != shape:
            raise UserError(
                f"readings: has shape {z.shape}, where {shape} belongs: epochs and readings of"
                f" {model.name}"
            )
        return cls(model, given_readings(z))


def _wanted(model: StateModel) -> list[str]:
    return [*model.log_inputs, *model.reading_names]


def _read(table: TextTable, model: StateModel) -> Log:
    columns = _headings(table, _wanted(model))
    _require_units_of_angles(table, columns, model)
    _require_rows(table)
    cells = {}
    for name, heading in columns.items():
        texts = table.column(heading)
        seconds = _seconds([text for text, _ in texts]) if name == "time" else None
        if seconds is None:
            seconds = np.array([table.value(*cell) for cell in texts])
        cells[name] = seconds

    def refuse(bad: Array, name: str, what: str) -> None:
        if bad.any():
            row, _ = table.rows[int(np.argmax(bad))]
            raise table.error(f"row {row}, column {columns[name]}: {what}")

    # Known inputs and readings as the model takes them.
    z = np.stack([cells[name] for name in model.reading_names], axis=1)
    for name in model.log_inputs:
        refuse(np.isnan(cells[name]), name, "is empty; a known input has a value at each epoch")
    for fault in model.faults({name: cells[name] for name in _wanted(model)}):
        refuse(fault.where, fault.column, fault.reason)
    if "time" in model.log_inputs:
        refuse(
            np.diff(cells["time"], prepend=-np.inf) < 0,
            "time",
            "is before the time of the row above; give rows in the order of their times",
        )
    model = model.with_log(len(z), {name: cells[name] for name in model.log_inputs})
    if len(z) != model.epochs:
        raise table.error(
            f"has {len(z)} rows, and {model.name} {model.epochs} epochs; give a row for each of"
            " them"
        )

    # Numbers and times of epochs, where the file has them, are those of the model.
    near = _SAME_TIME * (model.times[-1] - model.times[0]) / len(z)
    numbers = np.arange(1.0, len(z) + 1)
    for name, right, off in (("epoch", numbers, 0.0), ("time", model.times, near)):
        wrong = ~(np.abs(cells.get(name, right) - right) <= off)
        remedy = f"set ignore_columns=[{name}]"
        if name == "time" and isinstance(model, Formulas):
            remedy = (
                "take the times of the file by state_model.inputs.time=0, and dt for the steps"
                " between them in formulas"
            )
        refuse(
            wrong,
            name,
            f"{right[np.argmax(wrong)]:g} belongs here; give a row for each epoch, in order, or"
            f" {remedy}",
        )
    if not np.isfinite(z).any():
        raise table.error("has no reading")
    return Log(model, z, (str(table.path), table.digest))


def _seconds(texts: Sequence[str]) -> Array | None:
    """Reads ISO 8601 times as seconds since the first; None if they are none."""
    try:
        times = [datetime.fromisoformat(text.strip()) for text in texts]
        since = [(time - times[0]).total_seconds() for time in times]
    except (ValueError, TypeError):
        return None
    return np.array(since)


def _headings(table: TextTable, wanted: Sequence[str]) -> dict[str, str]:
    """Finds the headings of the columns that are wanted, and of epochs and times if they are
    there."""
    columns = {}
    for name in ("epoch", "time", *wanted):
        heading = table.find(name)
        if heading:
            columns[name] = heading
    for name in wanted:
        if name not in columns:
            raise table.error(f"column {name} is missing (the header must be {','.join(wanted)})")
    if unit_of(columns.get("time", "time")) not in ("", "s"):
        raise table.error(
            f"column {columns['time']}: the unit must be s, as in time [s]; convert the values"
        )
    table.require_known(list(columns.values()), wanted)
    return columns


def _require_units_of_angles(
    table: TextTable, columns: Mapping[str, str], model: StateModel
) -> None:
    """Refuses angles in a unit whose whole turn is another number than the model's."""
    for name, period in zip(model.reading_names, model.periods, strict=False):
        turn = _TURNS.get(unit_of(columns[name]), period)
        if period and not np.isclose(turn, period):
            raise table.error(
                f"column {columns[name]}: a whole turn is {period:g} in {model.name}; convert the"
                " values"
            )


def _require_rows(table: TextTable) -> None:
    """Refuses a table without rows, or with an empty one among them."""
    if not table.rows:
        raise table.error("has a header and no rows")
    for (row, _), (following, _) in pairwise(table.rows):
        if following > row + 1:
            raise table.error(
                f"row {row + 1}: is empty; if a reading is missing there, number the rows in a"
                " column epoch"
            )


@dataclass(frozen=True)
class Constant:
    """Holds a constant of largest likelihood."""

    name: str
    value: float
    error: float
    """Its standard error, by the curvature of the log likelihood."""
    low: float
    """The lower end of its 95 % interval, which for a standard deviation is symmetric in the
    logarithm."""
    high: float
    """Its upper end."""


@dataclass(frozen=True)
class LogTracks:
    """Holds the track of a log by one tracker, in the units of the states."""

    label: str
    tracker: Tracker
    mean: Array
    """States (K, n)."""
    deviation: Array
    """Their standard deviations (K, n)."""
    covariance: Array
    """Their covariance (K, n, n)."""
    predicted: Array
    """The readings (K, m) that were predicted from those before, NaN if the tracker has no
    innovations; where a reading is missing, the one that is expected at the state of its epoch."""
    predicted_deviation: Array
    """Their standard deviations (K, m)."""
    nis: Array
    """Squared normalised innovations (K,); NaN at epochs without readings, and if the tracker has
    none."""
    mean_nis: float
    """Their sum over the number of readings, or the cost of the path of a smoother: 1 on average if
    the model is right; NaN if the tracker has neither."""
    limits: tuple[float, float]
    """The interval that holds that mean with a probability of 95 % if the filter is right."""
    fit_p: float
    """The probability of a larger sum, or cost, if the model is right: chi-square with a degree per
    reading."""
    white_p: float
    """The p-value of Ljung and Box's test that innovations are white: those of the filter that is
    smoothed, if any."""
    log_likelihood: float
    """The log likelihood of the readings; NaN for a smoother."""
    passes: bool
    """Whether there is a track that is not lost, whose iteration, if it has one, has converged,
    whose innovations, or path, are no further from the model than chance explains, and whose
    innovations are white; and one maximum, if constants were asked for."""
    message: str
    """The reason why there is no track, or no constant; empty if there is one."""
    lost_from: int | None = None
    """The epoch, from 1 on, from which most innovations are larger than all but one in a million by
    chance; None if there is none."""
    effective: float = np.nan
    """The median effective sample size of an epoch, of a weighted sample; NaN if there is none."""
    constants: Sequence[Constant] = ()
    """The constants that were asked for."""
    smooths: bool = False
    """Whether later readings count."""
    found: str = ""
    """The verdict on the search for them; empty if one maximum was found."""
    gated: Mask | None = None
    """Readings (K, m) beyond the gate, which are left out; None without a gate."""
    weights: Array | None = None
    """By how much readings (K, m) count, in parts of one that is as expected, if their noise is
    Student's t; NaN of missing ones."""
    share_gated: float = 0.0
    """Their share of all readings."""
    notes: Sequence[str] = ()
    """Constants that are held at 0, other maxima that the searches have found, a second path that
    fits, and the epochs of outliers."""

    @classmethod
    def of(cls, log: Log, label: str, tracker: Tracker) -> LogTracks:
        tracks, messages = track_safely(tracker, log.model, log.z[None])
        sizes = np.array([state.size for state in log.model.states])
        mean = tracks.mean[0] * sizes
        deviation = deviations(tracks.covariance[0]) * sizes
        innovations = tracks.innovations.swapaxes(1, 2)
        predicted, predicted_deviation = tracks.predicted_readings(log.z[None])
        gated = None if tracks.gated is None else tracks.gated[0]
        weights = None if tracks.weights is None else tracks.weights[0]
        missing = np.isnan(log.z)
        share = 0.0
        if gated is not None:
            share = float(gated.sum() / (~missing).sum())
            missing |= gated
        if missing.any():
            h, of_states, noise = Expected.at(log.model, tracks)
            spread = np.sqrt(of_states + noise)
            predicted = np.where(missing, h, predicted)
            predicted_deviation = np.where(missing, spread, predicted_deviation)
        nis = np.where(tracks.degrees[0] > 0, tracks.nis[0], np.nan)

        # The squared misfit of the whole log, which is chi-square with a degree per reading.
        total = float(np.nansum(nis))
        m = int(np.isfinite(innovations).sum())
        if tracks.cost is not None:
            total = float(tracks.cost[0])
            m = int((~missing).sum())
        total /= _mean_within(tracker.gate)
        fit_p = float(chdtrc(m, total)) if m else np.nan
        white = float(white_p(_judged_innovations(log, tracker, innovations))[0])

        effective = np.nan if tracks.effective is None else float(np.median(tracks.effective))
        lost_from = _lost_from(nis, tracks.degrees[0])
        if gated is not None and tracker.gate is not None:
            lost_from = _blind_from(gated, np.isfinite(log.z), tracker.gate)
        ended = Status.CONVERGED if tracks.status is None else Status(int(tracks.status[0]))
        message = "" if ended == Status.CONVERGED else f"{ended.label}: {ended.reason}"
        if tracks.by_epoch is not None and tracks.by_epoch[0]:
            message = REDONE
        message = why_lost(log.model, tracks.mean).get(0, message)
        # What is not known, NaN, is no reason against a track.
        whole = bool(np.isfinite([mean, deviation]).all())
        fits = not fit_p < FIT_LEVEL and not white < FIT_LEVEL
        held = not effective < _COLLAPSED and lost_from is None
        if share > MOST_LEFT_OUT:
            message = (
                f"{100 * share:.0f} % of the readings lie beyond the gate, where a few should: the"
                " model or its noise does not fit the log"
            )
        return cls(
            label,
            tracker,
            mean,
            deviation,
            covariance=tracks.covariance[0] * np.outer(sizes, sizes),
            predicted=predicted[0],
            predicted_deviation=predicted_deviation[0],
            nis=nis,
            mean_nis=total / m if m else np.nan,
            limits=mean_limits(m, 1),
            fit_p=fit_p,
            white_p=white,
            log_likelihood=float(tracks.log_likelihood[0]) if tracks.degrees.any() else np.nan,
            passes=whole and fits and held and share <= MOST_LEFT_OUT and ended == Status.CONVERGED,
            message=messages.get(0, message),
            lost_from=lost_from,
            effective=effective,
            smooths=tracker.smooths,
            notes=[
                *_second(log, tracks),
                *_left_out(log, gated, "left out, as beyond the gate"),
                *_left_out(log, distrusted(weights), "counted by less than a tenth"),
                *_worst(log, nis, tracks.degrees[0], lost_from),
            ],
            gated=gated,
            weights=weights,
            share_gated=share,
        )

    @property
    def verdict(self) -> str:
        """Tells whether innovations are white and, as a smoother's path, as far from the model as
        it says, from where the track is lost, or what is wrong with the constants that were
        found."""
        if self.lost_from is not None:
            return f"{LOST} from time step {self.lost_from}"
        if self.effective < _COLLAPSED:
            return COLLAPSED
        if self.found:
            return self.found
        if self.share_gated > MOST_LEFT_OUT:
            return WRONG
        if np.isnan(self.mean_nis):
            return NO_VERDICT
        if self.white_p < FIT_LEVEL:
            return WRONG
        low, high = self.limits
        if self.mean_nis > high:
            return OVERCONFIDENT
        return TOO_CAUTIOUS if self.mean_nis < low else CONSISTENT


def _second(log: Log, tracks: Tracks) -> list[str]:
    """Words that a second path fits as well, if one was found that does."""
    if tracks.other is None or tracks.other_p is None or not tracks.other_p[0] > 1 - SURE:
        return []
    far = np.abs(log.model.nearest_state(tracks.other, tracks.mean) - tracks.mean)[0]
    # Distances in standard deviations of the states, so that those of unlike units compare.
    first = np.sqrt(np.diagonal(log.model.prior.covariance))
    size = np.where(first > 0, first, np.inf)
    k, i = np.unravel_index(np.argmax(far / size), far.shape)
    state = log.model.states[int(i)]
    distance = f"{far[k, i] * state.size:.4g} {state.unit}".rstrip()
    share = f"{tracks.other_p[0]:.2g}"
    if tracks.other_p[0] > 0.5:
        share += ", likelier than this one"
    return [
        f"AMBIGUOUS: a second path is right with a probability of {share}; in it"
        f" {state.name} differs by {distance} at time step {k + 1}, which the deviations count"
    ]


def _judged_innovations(log: Log, tracker: Tracker, innovations: Array) -> Array:
    """Returns innovations (1, m, K) of a tracker, or of the filter that it smooths, as a smoother
    has none."""
    if not isinstance(tracker, Smoother):
        return innovations
    tracks, _ = track_safely(tracker.filter, log.model, log.z[None])
    return tracks.innovations.swapaxes(1, 2)


def _lost_from(nis: Array, degrees: Array) -> int | None:
    """Finds the first epoch, from 1 on, whose NIS (K,) lies beyond the gate, and from which on most
    do, and some; None without one."""
    at = np.flatnonzero(np.isfinite(nis))
    beyond = chdtrc(degrees[at], nis[at]) < GATE
    following = np.cumsum(beyond[::-1])[::-1]
    share = following / np.arange(len(at), 0, -1)
    # An outlier at the end of a log is no loss.
    lost = at[beyond & (share > 0.5) & (following >= min(_LEAST_LOST, len(at)))]
    return int(lost[0]) + 1 if len(lost) else None


def _mean_within(gate: float | None) -> float:
    """Computes the mean of a chi-square with one degree that is below its quantile `gate`."""
    if gate is None:
        return 1.0
    most = chdtri(1.0, 1.0 - gate)
    return float(chdtr(3.0, most) / gate)


def _blind_from(gated: Mask, given: Mask, gate: float) -> int | None:
    """Finds the first epoch, from 1 on, of gated readings (K, m) from which on most epochs with a
    reading, of those that are given (K, m), have some, more of them than chance explains; None
    without one."""
    at = np.flatnonzero(given.any(axis=1))
    some = np.asarray(gated.any(axis=1))[at]
    following = np.cumsum(some[::-1])[::-1]
    left = np.arange(len(at), 0, -1)
    expected = 1 - gate ** gated.shape[1]
    by_chance = bdtrc(following - 1.0, left, expected) > GATE
    lost = at[some & (following > 0.5 * left) & ~by_chance]
    return int(lost[0]) + 1 if len(lost) else None


def distrusted(weights: Array | None) -> Mask | None:
    """Tells which readings hardly count by their weights."""
    return None if weights is None else weights < _HARDLY


def _left_out(log: Log, out: Mask | None, what: str) -> list[str]:
    """Words the readings that are left out, or what else is said of them."""
    if out is None or not out.any():
        return []
    at = np.argwhere(out)
    names = log.model.reading_names
    listed = [f"{k + 1}" if len(names) == 1 else f"{k + 1} ({names[j]})" for k, j in at]
    further = len(listed) - _MOST_GATED_SHOWN
    others = f" and {further} more" if further > 0 else ""
    return [
        f"{what}: {len(at)} of {np.isfinite(log.z).sum()} readings, at time"
        f" steps {', '.join(listed[:_MOST_GATED_SHOWN])}{others}"
    ]


def _worst(log: Log, nis: Array, degrees: Array, lost_from: int | None) -> list[str]:
    """Words the epochs whose NIS (K,) is so large that chance has one in a whole log with a
    probability of 1 %, the worst first, or how many they are; none if the track is lost."""
    at = np.flatnonzero(np.isfinite(nis))
    beyond = at[chdtrc(degrees[at], nis[at]) < OUTLIER_LEVEL / max(len(at), 1)]
    few = max(_FEW, _SHARE * len(at))
    if lost_from is not None or not 0 < len(beyond) <= max(few, _MOST_OUTLYING * len(at)):
        return []
    if len(beyond) > few:
        return [
            f"{len(beyond)} of {len(at)} time steps are further from their predictions than chance"
            " explains; if these are outliers, gate=0.999 leaves them out"
        ]
    listed = sorted(beyond, key=lambda k: -nis[k])[:_MOST_OUTLIERS]
    epochs = ", ".join(f"{k + 1} (NIS {nis[k]:.3g})" for k in listed)
    further = len(beyond) - len(listed)
    others = f" and {further} more" if further else ""
    return [
        f"outliers, whose readings are further from their predictions than chance explains:"
        f" time steps {epochs}{others}; empty a cell to leave its reading out, as gate=0.999 does"
    ]


def far_below(tracks: Sequence[LogTracks]) -> list[str]:
    """Returns a line for each track whose predictions are far less likely than the best of those
    whose innovations fit.

    A filter that linearises has the likelihood of its own approximation, so that the largest one
    may be of a track that is lost: an overconfident track, or one whose innovations are not white,
    is no standard for others.
    """
    fitting = [one for one in tracks if one.verdict in (CONSISTENT, TOO_CAUTIOUS)]
    sound = [one for one in fitting if np.isfinite(one.log_likelihood)]
    if not sound:
        return []
    best = max(sound, key=lambda one: one.log_likelihood)
    limit = _FAR_BELOW + np.isfinite(best.nis).sum() / 10
    below = {one.label: best.log_likelihood - one.log_likelihood for one in tracks}
    return [
        f"{label}: {best.label} predicts each next reading far better, by {less:.4g} in log"
        " likelihood"
        for label, less in below.items()
        if less > limit
    ]


@dataclass(frozen=True)
class LogQuestion:
    """Asks for the tracks of logs of a model by each tracker, and for the constants `find` that the
    logs share."""

    logs: Sequence[Log]
    trackers: Mapping[str, Tracker]
    find: Sequence[str] = ()

    @classmethod
    def of(
        cls,
        model: StateModel,
        readings: Any,
        trackers: Mapping[str, Tracker],
        ignored: Sequence[str] = (),
        find: str | Sequence[str] = (),
        gate: float | None = None,
    ) -> LogQuestion:
        """Reads a log, or several that are independent of each other, and checks that every tracker
        can follow them.

        Raises:
            UserError: the readings are not this model's, or a tracker needs what is not given.
        """
        if not isinstance(readings, Sequence) or isinstance(readings, str):
            readings = [readings]
        _require_distinct(readings)
        if gate is not None:
            trackers = {label: _gated(label, one, gate) for label, one in trackers.items()}
        require_parts(model)
        logs = []
        for one in readings:
            log = Log.of(model, Path(one) if isinstance(one, str) else one, ignored)
            validate([StateScenario(log.model)], trackers, 1, untried=[])
            logs.append(log)
        names = [find] if isinstance(find, str) else list(find)
        for label, tracker in trackers.items() if names else ():
            for log in logs:
                require_likelihood(log, label, tracker)
        return cls(logs, trackers, names)

    def track(self, label: str, watch: Callable[[str], object] = str) -> list[LogTracks]:
        """Tracks each log by one tracker; `watch` is told how far a search is."""
        tracker = self.trackers[label]
        if self.find:
            return found_and_tracked(self.logs, label, tracker, self.find, watch)
        return [LogTracks.of(log, label, tracker) for log in self.logs]


def _require_distinct(readings: Sequence[Any]) -> None:
    """Refuses no file, and one that is named twice."""
    if not readings:
        raise UserError("readings=[]: is empty; name a file")
    files = [str(one) for one in readings if isinstance(one, str | Path)]
    for file in files:
        if files.count(file) > 1:
            raise UserError(f"readings: {file} is given twice; name each file once")


def _gated(label: str, tracker: Tracker, gate: float) -> Tracker:
    try:
        return tracker.gated(gate)
    except UserError as error:
        raise UserError(f"gate={gate:g}: trackers.{label} {error}") from None


# Constants ---------------------------------------------------------------------------------------


def require_likelihood(log: Log, label: str, tracker: Tracker) -> None:
    """Refuses a tracker whose likelihood no search can maximise.

    Raises:
        UserError: its likelihood is random, or it has none, or jumps.
    """
    if tracker.gate is not None:
        raise UserError(
            f"find: the likelihood of trackers.{label} jumps where a reading passes its gate;"
            " remove the gate"
        )
    tracks, _ = track_safely(tracker, log.model, log.z[None])
    known = tracks.degrees.any() and np.isfinite(tracks.log_likelihood[0])
    if isinstance(tracker, Bootstrap) or not known:
        raise UserError(
            f"find: trackers.{label} has no likelihood that can be maximised; choose a filter"
        )


def found_and_tracked(
    logs: Sequence[Log],
    label: str,
    tracker: Tracker,
    find: Sequence[str],
    watch: Callable[[str], object] = str,
) -> list[LogTracks]:
    """Finds the constants `find` under which a tracker finds independent logs of a model most
    likely, and the track of each with them; `watch` is told at each evaluation of the likelihood
    how far the search is.

    Raises:
        UserError: the model has no such constant.
    """
    sought = _Sought.of(logs[0].model, find)

    def cost(u: Array) -> float:
        """Computes minus the log likelihood; infinite where there is none."""
        logarithms = u[sought.positive]
        if (np.isfinite(logarithms) & (np.abs(logarithms) >= _FAR)).any():
            return np.inf
        if not np.isfinite(sought.values(u)).all():
            return np.inf
        total = 0.0
        for log in logs:
            try:
                model = sought.near(log.model, u)
            except UserError:
                # A model in Python may take no 0.
                return np.inf
            if tracker.hindrance(model):
                return np.inf
            tracks, _ = track_safely(tracker, model, log.z[None])
            value = -float(tracks.log_likelihood[0])
            if not tracks.degrees.any() or not np.isfinite(value):
                return np.inf
            total += value
        return total

    with np.errstate(invalid="ignore"), unchanged():
        best, *others = _minima(cost, sought.positive, watch)
    if not best.is_maximum:
        message = (
            f"no maximum of the likelihood was found in {', '.join(find)}: the log may not"
            f" determine all of them; the search ended after {best.evaluations} evaluations at"
            f" {sought.written(best)}, and the track uses the model's own values"
        )
        own = [LogTracks.of(log, label, tracker) for log in logs]
        return [replace(one, message=message, found=NO_MAXIMUM, passes=False) for one in own]
    with np.errstate(invalid="ignore"), unchanged():
        found_constants = sought.constants(best, cost, watch)
    notes = [_at_zero_words(one) for one in found_constants if one.value == 0]
    notes += [
        f"another maximum, of a log likelihood {one.cost - best.cost:.3g} lower, is at"
        f" {sought.written(one)}"
        for one in others
        if one.is_maximum
    ]
    several = any(
        one.is_maximum and one.cost - best.cost < _ALIKE and sought.is_beyond(found_constants, one)
        for one in others
    )

    def tracked(log: Log) -> LogTracks:
        """Tracks a log with the constants."""
        track = LogTracks.of(replace(log, model=sought.at(log.model, best.u)), label, tracker)
        found = ""
        message = track.message
        if track.fit_p < FIT_LEVEL or track.white_p < FIT_LEVEL:
            message = (
                "find= ended at a maximum whose innovations do not fit (NIS: p ="
                f" {track.fit_p:.2g}; white: p = {track.white_p:.2g}): the model does not describe"
                " the log, and neither values nor errors can be trusted"
            )
        elif several:
            found = SEVERAL_MAXIMA
            message = "several maxima fit the log almost equally well"
        return replace(
            track,
            constants=found_constants,
            notes=[*track.notes, *notes],
            found=found,
            message=message,
            passes=track.passes and not found,
        )

    return [tracked(log) for log in logs]


def _at_zero_words(one: Constant) -> str:
    """Says that a deviation is held at 0, and how large it may be."""
    held = f"the likelihood is largest at {one.name}=0, where it is held"
    if np.isinf(one.high):
        return f"{held}; the log sets it no upper limit"
    return (
        f"{held}; its 95 % interval is 0 to {one.high:.3g} (95 % is of all logs, and less of those"
        " in which it is held)"
    )


@dataclass(frozen=True)
class _Sought:
    """Holds the numbers of a model that are looked for, as functions of coordinates u that are 0 at
    the model's own values."""

    model: StateModel
    names: Sequence[str]
    places: Sequence[tuple[str, str]]
    """Their keys and names, as `_numbers` has them."""
    start: Array
    """The model's own values."""
    positive: Mask
    """Which have the logarithm of their factor as a coordinate."""

    @classmethod
    def of(cls, model: StateModel, find: Sequence[str]) -> _Sought:
        numbers = _numbers(model)
        places = [_place(list(numbers), name) for name in find]
        for name, place in zip(find, places, strict=True):
            if places.count(place) > 1:
                raise UserError(f"find={name}: is named twice; name it once")
        start = np.array([numbers[place][0] for place in places])
        positive = np.array([numbers[place][1] for place in places])
        zero = positive & ~(start > 0)
        if zero.any():
            name = find[int(np.argmax(zero))]
            raise UserError(f"find={name}: is 0; give a value above to start from")
        return cls(model, find, places, start, positive)

    @cached_property
    def size(self) -> Array:
        """The units of the coordinates that are no logarithms."""
        return np.where(self.start == 0, 1.0, np.abs(self.start))

    def values(self, u: Array) -> Array:
        logarithms = np.where(self.positive, u, 0.0)
        scaled = self.start * np.exp(logarithms)
        return np.where(self.positive, scaled, self.start + self.size * u)

    def written(self, end: _Minimum) -> str:
        """Words the numbers at the end of a search."""
        values = zip(self.names, np.where(end.zero, 0.0, self.values(end.u)), strict=True)
        return ", ".join(f"{name}={value:.4g}" for name, value in values)

    def at(self, model: StateModel, u: Array) -> StateModel:
        """Returns the model of a log with the numbers at u."""
        return replace(model, **self._options(u))  # type: ignore[type-var]

    def near(self, model: StateModel, u: Array) -> StateModel:
        """Returns the same model, whose functions are not tried again."""
        return model.with_numbers(self._options(u))

    def _options(self, u: Array) -> dict[str, Any]:
        parts: dict[str, Any] = {}
        for (key, name), value in zip(self.places, self.values(u).tolist(), strict=True):
            if name:
                value = {**parts.get(key, getattr(self.model, key)), name: value}
            parts[key] = value
        return parts

    def is_beyond(self, constants: Sequence[Constant], end: _Minimum) -> bool:
        """Tells whether the end of a search lies outside the intervals of constants."""
        values = np.where(end.zero, 0.0, self.values(end.u))
        pairs = zip(constants, values, strict=True)
        return any(not one.low <= value <= one.high for one, value in pairs)

    def constants(
        self, best: _Minimum, cost: Callable[[Array], float], watch: Callable[[str], object]
    ) -> list[Constant]:
        """Returns the numbers at a minimum of a cost, with intervals that are normal in u, or those
        of the profile where a deviation is uncertain or held at 0."""
        values = np.where(best.zero, 0.0, self.values(best.u))
        errors = np.where(self.positive, values, self.size) * best.error
        reach = float(ndtri(0.975)) * best.error
        ends = np.stack([best.u - reach, best.u + reach])
        for i in np.flatnonzero(best.zero | self.positive & (best.error > _CERTAIN)):
            search = _Search(cost, f"interval of {self.names[int(i)]}", watch)
            ends[:, i] = _Profile(search, best, int(i), self.positive).limits()
        low, high = map(self.values, ends)
        rows = np.column_stack([values, errors, low, high]).tolist()
        return [Constant(name, *row) for name, row in zip(self.names, rows, strict=True)]


def _numbers(model: StateModel) -> dict[tuple[str, str], tuple[float, bool]]:
    """Returns the numbers of a model that can be found, and whether each is positive: by key and
    name of a model by formulas, by option of one in Python."""
    if isinstance(model, Formulas):
        return {
            (key, name): (value, key != "constants")
            for key in _KEYS
            for name, value in getattr(model, key).items()
            if not isinstance(value, str)
        }
    options = {
        name: hint
        for name, hint in option_types(type(model)).items()
        if hint in (*_POSITIVE, float, Finite)
    }
    return {(name, ""): (getattr(model, name), hint in _POSITIVE) for name, hint in options.items()}


def _place(known: Sequence[tuple[str, str]], name: str) -> tuple[str, str]:
    """Returns the key and the name of a number, which may be written KEY.NAME."""
    found = [one for one in known if name in (one[1] or one[0], ".".join(one))]
    if len(found) > 1:
        raise UserError(
            f"find={name}: is a name of two numbers; write {' or '.join(map('.'.join, found))}"
        )
    if not found:
        names = [label or key for key, label in known]
        raise UserError(f"find={name}: {unknown(name, names, 'constant')}")
    return found[0]


@dataclass(frozen=True)
class _Minimum:
    """Holds where a search for a minimum of a cost ended."""

    u: Array
    cost: float
    error: Array
    """Standard errors by the second derivatives; NaN if the cost has no minimum there, and for
    those that are 0."""
    H: Array
    """The second derivatives by the others."""
    evaluations: int
    """Evaluations of the cost in the search."""
    zero: Mask
    """The positive ones that are held at 0, as the cost rises from there."""

    @property
    def is_maximum(self) -> bool:
        """Whether the likelihood has a maximum here, on its bound or inside."""
        return bool(np.isfinite(self.error[~self.zero]).all())

    def holds(self, u: Array, cost: float) -> bool:
        """Whether u is within a standard error of this minimum."""
        away = (u - self.u)[~self.zero]
        near = bool(away @ self.H @ away < 1)
        # Near 0 the logarithm of a deviation says nothing.
        return near and (not self.zero.any() or cost - self.cost < 0.5)


@dataclass
class _Search:
    """Counts the evaluations of a cost in one search for its minimum."""

    cost: Callable[[Array], float]
    name: str
    watch: Callable[[str], object]
    evaluations: int = 0

    def __call__(self, u: Array) -> float:
        self.evaluations += 1
        self.watch(f"{self.name}, evaluation {self.evaluations} of at most {EVALUATIONS}")
        return self.cost(u)

    @property
    def left(self) -> int:
        """Evaluations that are left, but for the last."""
        return EVALUATIONS - 1 - self.evaluations


def _minima(
    cost: Callable[[Array], float], positive: Mask, watch: Callable[[str], object] = str
) -> list[_Minimum]:
    """Finds the different ends of `SEARCHES` searches, the lowest first. They begin at 0 and at
    draws of N(0, I), or nearer to 0 if the cost is infinite there. Those that are `positive` are
    logarithms."""
    n = len(positive)
    found: list[_Minimum] = []
    draws = np.random.default_rng(0).standard_normal((SEARCHES - 1, n))
    for number, start in enumerate([np.zeros(n), *draws], 1):
        search = _Search(cost, f"search {number} of {SEARCHES}", watch)
        nearer = (start, start / 2, start / 8, 0 * start)
        first = next(u for u in nearer if np.isfinite(search(u)))
        u, reached = _descended(search, first)
        # A search that comes near a minimum that is known need not be ended.
        if any(one.holds(u, reached) for one in found):
            continue
        end = _ended(search, u, positive)
        if not any(one.holds(end.u, end.cost) for one in found):
            found.append(end)
    best = min(found, key=lambda one: one.cost)
    for i in np.flatnonzero(positive & (best.error > _CERTAIN)):
        search = _Search(cost, f"search at 0 beside {len(found)} ends", watch)
        end = _on_bound(search, best, int(i), positive)
        if end is not None and not any(one.holds(end.u, end.cost) for one in found):
            found.append(end)
    # A maximum is the answer unless the likelihood is larger where there is none.
    return sorted(found, key=lambda one: one.cost + (0.0 if one.is_maximum else _EFFECT))


def _descended(search: Callable[[Array], float], u: Array) -> tuple[Array, float]:
    """Finds where a search by Nelder and Mead's simplex ends, and the cost there."""
    from scipy.optimize import minimize

    simplex = np.vstack([u, u + 0.5 * np.eye(len(u))])
    options = {"initial_simplex": simplex, "xatol": 0.1, "fatol": 0.1, "maxfev": _OF_SIMPLEX}
    ended = minimize(search, u, method="Nelder-Mead", options=options)
    return np.asarray(ended.x), float(ended.fun)


def _ended(search: _Search, u: Array, positive: Mask) -> _Minimum:
    """Finds the minimum near u, inside or where positive ones are 0."""
    zero = np.zeros(len(u), dtype=bool)
    end = _polished(search, u, positive, zero)
    if end.is_maximum:
        return end
    u = end.u.copy()
    for i in np.flatnonzero(positive):
        held = _at_zero(search, u, int(i))
        if held is not None:
            u[i] = held
            zero[i] = True
    if not zero.any():
        return end
    return _polished(search, u, positive, zero)


def _on_bound(search: _Search, best: _Minimum, i: int, positive: Mask) -> _Minimum | None:
    """Finds the minimum at which one more positive one is 0; None if there is none."""
    u = best.u.copy()
    for logarithm in (-np.inf, best.u[i] - _NEAR_ZERO):
        u[i] = logarithm
        if np.isfinite(search(u)):
            break
    zero = best.zero.copy()
    zero[i] = True
    end = _polished(search, u, positive, zero)
    inside = end.u.copy()
    inside[i] = best.u[i] - _NEAR_ZERO
    if not end.is_maximum or _at_zero(search, inside, i) is None:
        return None
    return end


def _at_zero(search: _Search, u: Array, i: int) -> float | None:
    """Returns the logarithm that stands for 0 of a positive one, if the cost rises from there; else
    None."""
    here = search(u)
    up = u.copy()
    change = 0.0
    while abs(change) <= _EFFECT:
        up[i] += 1.0
        if up[i] >= _FAR:
            return None
        change = search(up) - here
    if change < 0:
        return None
    down = u.copy()
    for logarithm in (-np.inf, up[i] - _NEAR_ZERO):
        down[i] = logarithm
        # The others, which stay where they are, raise the cost a little, too.
        if search(down) <= here + 3 * _EFFECT:
            return float(logarithm)
    return None


class _Profile:
    """The cost, least by the others, as a function of one number's coordinate, less its minimum."""

    def __init__(self, search: _Search, best: _Minimum, i: int, positive: Mask) -> None:
        self.search = search
        self.best = best
        self.i = i
        self.positive = positive
        self.held = best.zero.copy()
        self.held[i] = True
        self.u = best.u
        """Where the others were least."""

    def __call__(self, value: float) -> float:
        u = self.u.copy()
        u[self.i] = value
        self.search.evaluations = 0
        end = _polished(self.search, u, self.positive, self.held)
        if end.is_maximum:
            self.u = end.u
        return min(end.cost - self.best.cost, _FAR)

    def limits(self) -> tuple[float, float]:
        """Finds between which coordinates of a positive number the profile is below the limit of 95
        %: from minus infinity on if it is so at 0."""
        if self.best.zero[self.i]:
            start = 0.0
            while self(start) > _LOST:
                start -= 1.0
            return -np.inf, self._end(start, 1.0, _FAR)
        start = float(self.best.u[self.i])
        ends = ((-1.0, _NEAR_ZERO), (1.0, _FAR))
        low, high = (self._end(start, step, most) for step, most in ends)
        return low, high

    def _end(self, start: float, step: float, most: float) -> float:
        """Finds where the profile passes the limit, in steps from a start below it; infinite if it
        does not within so much."""
        from scipy.optimize import brentq

        known = cache(self)
        inside = start
        known(inside)
        while known(inside + step) < _LOST:
            inside += step
            if abs(inside - start) >= most:
                return float(np.copysign(np.inf, step))
        ends = sorted((inside, inside + step))
        return float(brentq(lambda value: known(value) - _LOST, *ends, xtol=1e-3))  # type: ignore[arg-type]


def _polished(search: _Search, u: Array, positive: Mask, held: Mask) -> _Minimum:
    """Finds the end of Newton's iteration from u by those that are not `held`."""
    free = np.flatnonzero(~held)
    n = len(free)
    error = np.full(len(u), np.nan)
    if not n:
        return _Minimum(u, search(u), error, np.zeros((0, 0)), search.evaluations, held)

    def cost(values: Array) -> float:
        return search(placed(values))

    def placed(values: Array) -> Array:
        whole = u.copy()
        whole[free] = values
        return whole

    end = _by_newton(search, cost, u[free], positive[free])
    if end.deviation is None and held.any():
        v, _ = _descended(cost, end.v)
        end = _by_newton(search, cost, v, positive[free])
    error[free] = np.nan if end.deviation is None else end.deviation
    return _Minimum(placed(end.v), end.cost, error, end.H, search.evaluations, held)


class _End(NamedTuple):
    """Holds where Newton's iteration ended."""

    v: Array
    cost: float
    deviation: Array | None
    """None if there is no minimum."""
    H: Array


def _by_newton(search: _Search, cost: Callable[[Array], float], v: Array, positive: Mask) -> _End:
    """Iterates until a step is small, or a logarithm has hardly any effect on the cost."""
    n = len(v)
    h = np.full(n, 1e-2)
    rounds = search.left // (n**2 + n + 1)
    for _ in range(min(_ROUNDS, rounds)):
        here, g, H = _derivatives(cost, v, h)
        # Without a positive definite H there is no minimum near.
        if not (np.isfinite(H).all() and np.linalg.eigvalsh(H)[0] > 0):
            break
        # The inverse of the second derivatives of minus the log likelihood is the covariance of
        # its maximum.
        P = np.linalg.inv(H)
        deviation = deviations(P)
        if (deviation[positive] >= _VAGUE).any():
            break
        v = v - P @ g
        h = _STEP * deviation
        if g @ P @ g < _DONE:
            return _End(v, here, deviation, H)
    return _End(v, cost(v), None, np.full((n, n), np.nan))


def _derivatives(cost: Callable[[Array], float], u: Array, h: Array) -> tuple[float, Array, Array]:
    """Computes a cost with its first (n,) and second (n, n) derivatives by central differences of
    the steps h (n,)."""
    steps = np.diag(h)
    here = cost(u)
    up = np.array([cost(u + step) for step in steps])
    down = np.array([cost(u - step) for step in steps])
    g = (up - down) / (2 * h)
    H = np.diag((up - 2 * here + down) / h**2)
    for i, j in combinations(range(len(u)), 2):
        step = steps[i] + steps[j]
        both = cost(u + step) + cost(u - step) + 2 * here
        mixed = both - up[i] - up[j] - down[i] - down[j]
        H[i, j] = mixed / (2 * h[i] * h[j])
        H[j, i] = H[i, j]
    return here, g, H
