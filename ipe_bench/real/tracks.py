"""Tracks of real readings: a log is read epoch by epoch, and trackers follow the states of a model through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.special import chdtrc

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, deviations
from ipe_bench.real.readings import Table, read_tables
from ipe_bench.states.base import StateModel
from ipe_bench.states.formulas import Formulas, Recorded
from ipe_bench.states.trackers import Tracker
from ipe_bench.statistics.intervals import mean_limits
from ipe_bench.trials.thresholds import FIT_LEVEL
from ipe_bench.trials.tracking import track_safely
from ipe_bench.trials.whiteness import lags_of, ljung_box

_SAME_TIME = 1e-3
"""Part of the shortest step by which a time of a log may differ from that of its epoch."""


@dataclass(frozen=True)
class Log:
    """Readings of a model's epochs."""

    model: StateModel
    """With as many epochs as the file has rows, and with the inputs of the file, if it is written in formulas."""
    z: Array
    """(K, m); NaN where a reading is missing."""
    file: tuple[str, str] | None = None
    """The file with the SHA-256 of the bytes that were read."""

    @classmethod
    def of(cls, model: StateModel, readings: Path | Array | None, ignored: Sequence[str] = ()) -> Log:
        """The readings of a CSV or Parquet file without the columns `ignored`, an array z (K, m), or those that come
        with the model.

        Raises:
            UserError: they are not readings of this model.
        """
        if isinstance(readings, Path):
            return _read(read_tables([readings], ignored)[0], model)
        if readings is None and not isinstance(model, Recorded):
            raise UserError(f"readings: is not given; write readings=FILE, with the columns {','.join(_wanted(model))}")
        z = model.draw(0, 1).z[0] if readings is None else np.array(readings, dtype=float)
        if z.shape != (shape := (model.epochs, len(model.reading_names))):
            raise UserError(
                f"readings: has shape {z.shape}, where {shape} belongs: epochs and readings of {model.name}"
            )
        return cls(model, z)


def _wanted(model: StateModel) -> list[str]:
    return [*(model.inputs if isinstance(model, Formulas) else ()), *model.reading_names]


def _read(table: Table, model: StateModel) -> Log:
    wanted = _wanted(model)
    columns = {name: heading for name in ("epoch", "time", *wanted) if (heading := table.find(name))}
    for name in wanted:
        if name not in columns:
            raise table.error(f"column {name} is missing (the header must be {','.join(wanted)})")
    table.require_known(list(columns.values()), wanted)
    if not table.rows:
        raise table.error("has a header and no rows")
    if gap := next((a + 1 for (a, _), (b, _) in pairwise(table.rows) if b > a + 1), None):
        raise table.error(f"row {gap}: is empty; if a reading is missing there, number the rows in a column epoch")

    def refuse(bad: Array, name: str, what: str) -> None:
        if bad.any():
            raise table.error(f"row {table.rows[int(np.argmax(bad))][0]}, column {columns[name]}: {what}")

    cells = {name: np.array([table.value(*cell) for cell in table.column(at)]) for name, at in columns.items()}
    z = np.stack([cells[name] for name in model.reading_names], axis=1)
    if isinstance(model, Formulas):
        for name in model.inputs:
            refuse(np.isnan(cells[name]), name, "is empty; a known input has a value at each epoch")
        model = replace(model, count=len(z), inputs={name: tuple(cells[name].tolist()) for name in model.inputs})
    if len(z) != model.epochs:
        raise table.error(f"has {len(z)} rows, and {model.name} {model.epochs} epochs; give a row for each of them")
    near = _SAME_TIME * (model.times[-1] - model.times[0]) / len(z)
    for name, right, off in (("epoch", np.arange(1.0, len(z) + 1), 0.0), ("time", model.times, near)):
        wrong = ~(np.abs(cells.get(name, right) - right) <= off)
        said = f"{right[np.argmax(wrong)]:g} belongs here; give a row for each epoch, in order, or set ignore_columns"
        refuse(wrong, name, f"{said}=[{name}]")
    if not np.isfinite(z).any():
        raise table.error("has no reading")
    return Log(model, z, (str(table.path), table.digest))


@dataclass(frozen=True)
class Constant:
    """A constant of largest likelihood."""

    name: str
    value: float
    error: float
    """Its standard error, by the curvature of the log likelihood."""
    low: float
    """The lower end of its 95 % interval, which for a standard deviation is symmetric in the logarithm."""
    high: float


@dataclass(frozen=True)
class Tracked:
    """What one tracker makes of a log, in the units of the states."""

    label: str
    mean: Array
    """States (K, n)."""
    deviation: Array
    """Their standard deviations (K, n)."""
    nis: Array
    """Squared normalised innovations (K,); NaN at epochs without readings, and if the tracker has none."""
    mean_nis: float
    """Their sum over the number of readings: 1 on average if the filter is right."""
    limits: tuple[float, float]
    """Where that mean lies with a probability of 95 % if the filter is right."""
    white_p: float
    """The p-value of Ljung and Box's test that innovations are white."""
    log_likelihood: float
    """Of the readings; NaN for a smoother."""
    passes: bool
    """Whether there is a track, and its innovations are no larger than chance explains."""
    message: str
    """Why there is no track, or no constant; empty if there is one."""
    constants: Sequence[Constant] = ()
    """Those that were asked for."""

    @classmethod
    def of(cls, log: Log, label: str, tracker: Tracker) -> Tracked:
        tracks, messages = track_safely(tracker, log.model, log.z[None])
        sizes, innovations = np.array([state.size for state in log.model.states]), tracks.innovations.swapaxes(1, 2)
        mean, deviation = tracks.mean[0] * sizes, deviations(tracks.covariance[0]) * sizes
        nis = np.where(tracks.degrees[0] > 0, tracks.nis[0], np.nan)
        m, total = int(np.isfinite(innovations).sum()), float(np.nansum(nis))
        return cls(
            label,
            mean,
            deviation,
            nis,
            mean_nis=total / m if m else np.nan,
            limits=mean_limits(m, 1),
            white_p=float(chdtrc(lags_of(log.model.epochs), ljung_box(innovations)[0])),
            log_likelihood=float(tracks.log_likelihood[0]) if tracks.degrees.any() else np.nan,
            passes=bool(np.isfinite([mean, deviation]).all() and not chdtrc(max(m, 1), total) < FIT_LEVEL),
            message=messages.get(0, ""),
        )

    @property
    def verdict(self) -> str:
        """Whether the covariance of the innovations is as large as they are."""
        if not np.isfinite(self.mean_nis):
            return "-"
        low, high = self.limits
        return "optimistic" if self.mean_nis > high else "pessimistic" if self.mean_nis < low else "consistent"
