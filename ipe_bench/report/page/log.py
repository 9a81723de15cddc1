"""Tracks of real readings: tables, picture and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.measurements.base import with_unit
from ipe_bench.real.logs import SEARCHES, Log, LogQuestion, LogTracks, far_below
from ipe_bench.report.page.answer import Labelled, as_json, between, read_from, with_error
from ipe_bench.report.page.writer import write_files, write_result
from ipe_bench.report.tables.table import (
    Fact,
    Legend,
    Part,
    Strong,
    Table,
    interval,
    naming,
    texts,
    words,
)
from ipe_bench.report.words import enumerate_few, p_value, percent, short
from ipe_bench.statistics.verdicts import CONSISTENT, NO_VERDICT, shown
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.progress import Shows

NAME = "track"
FILES = ("track.csv",)
SCHEMA = 1
_NOTE = (
    "NIS / m: mean square of innovations in predicted standard deviations; smoothers: cost of the"
    " path. fit p: probability of a larger one. white p: Ljung and Box. Lost: from the time step"
    " from which most innovations exceed all but one in a million. The verdict is on innovations:"
    " an error that readings do not show, such as the turn of a whole map, leaves it right."
    " A dash: not available."
)
_OF_PARTICLES = (
    "Innovations of particles are by the mean and covariance of the readings that they predict;"
    " effective particles: 1 / sum of squared weights, the median of all time steps; collapsed:"
    " below 2."
)
_OF_GATES = (
    "A reading whose own innovation, or distance from the path of all others (lm_ieks, auto), lies"
    " beyond the gate counts as missing; NIS is divided by its mean within the gate."
)
_OF_TAILS = (
    "Innovations by Student's t are the normal numbers that are as probable. The filter's"
    " likelihood and covariance hold for normal predicted states; a path's cost is about"
    " chi-square. A reading has weight 1 where it is predicted."
)
_OF_CONSTANTS = (
    f"Constants have the largest likelihood that {SEARCHES} searches found. They were fitted to"
    " the innovations, so only whiteness tests the model. Intervals of uncertain deviations are"
    " profiles of the likelihood, down to where it is 1.92 lower; of one that is held at 0, they"
    " hold in 95 % of all logs, and in less of those in which it is held."
)
_STORED = (
    *("lost_from", "effective", "message", "notes", "mean_nis", "limits", "verdict"),
    *("fit_p", "white_p", "log_likelihood", "passes"),
)
"""What track.json says of each tracker, by its names in Python."""


@dataclass(frozen=True)
class LogAnswer(Labelled[LogTracks]):
    """Holds the tracks of one log, one for each tracker."""

    log: Log
    tracks: Sequence[LogTracks]
    name: str = ""
    """Tells it from those of other logs of one question."""

    @classmethod
    def to(cls, question: LogQuestion, progress: Shows = True) -> list[LogAnswer]:
        """Returns the answer to a question on each log; `progress` is as in
        `ipe_bench.estimate`."""
        from ipe_bench.report.progress import counting

        labels = list(question.trackers)
        with counting("estimate", len(labels), progress) as begin:
            each = [question.track(label, begin(label)) for label in labels]
        logs = question.logs
        tracks = zip(*each, strict=True)
        return [cls(*one) for one in zip(logs, tracks, _names(logs), strict=True)]

    @property
    def passes(self) -> bool:
        """Whether the track of any tracker passes every test."""
        return any(one.passes for one in self.tracks)

    @property
    def each(self) -> Sequence[LogTracks]:
        return self.tracks

    def table(self) -> pd.DataFrame:
        """Returns a row per tracker and epoch: each state and each predicted reading with its
        standard deviation, the readings, and NIS."""
        import pandas as pd

        return pd.concat([self._rows(one) for one in self.tracks], ignore_index=True)

    def _rows(self, one: LogTracks) -> pd.DataFrame:
        """Returns a row per epoch of one tracker."""
        import pandas as pd

        model = self.log.model
        columns: dict[str, Any] = {"tracker": one.label}
        columns |= {"epoch": range(1, model.epochs + 1), "time [s]": model.times}
        for i, state in enumerate(model.states):
            name = state.name
            columns[with_unit(name, state.unit)] = one.mean[:, i]
            columns[with_unit(f"{name}_deviation", state.unit)] = one.deviation[:, i]
        for j, name in enumerate(model.reading_names):
            columns[f"{name}_reading"] = self.log.z[:, j]
            columns[f"{name}_predicted"] = one.predicted[:, j]
            columns[f"{name}_predicted_deviation"] = one.predicted_deviation[:, j]
            if one.gated is not None:
                columns[f"{name}_left_out"] = one.gated[:, j]
            if one.weights is not None:
                columns[f"{name}_weight"] = one.weights[:, j]
        columns["nis"] = one.nis
        return pd.DataFrame(columns)

    def parts(self) -> list[Part]:
        """Returns the test of the innovations of each tracker, and the states at the last epoch."""
        said = [
            f"{one.label}: {text}"
            for one in self.tracks
            for text in (one.message, *one.notes)
            if text
        ]
        warnings = [Strong(text) for text in (*said, *far_below(self.tracks))]
        heading = [Strong(f"Log {self.name}")] if self.name else []
        tables = [*self._constants(), self._innovations(), self._last_states()]
        return [*heading, *warnings, *tables]

    def _innovations(self) -> Table:
        found = self.tracks
        low = [one.limits[0] for one in found]
        high = [one.limits[1] for one in found]
        likelihoods = [f"{one.log_likelihood:.2f}".replace("nan", "-") for one in found]
        columns = [
            words("tracker", [one.label for one in found]),
            texts("NIS or cost / m", [short(one.mean_nis) for one in found]),
            interval("95 % if right", low, high, short),
            words("verdict", [shown(one.verdict) for one in found]),
            texts("fit p", [p_value(one.fit_p) for one in found]),
            texts("white p", [p_value(one.white_p) for one in found]),
            texts("log likelihood", likelihoods),
        ]
        notes = [Legend(_NOTE)]
        if np.isfinite([one.effective for one in found]).any():
            columns.append(texts("effective particles", [short(one.effective) for one in found]))
            notes.append(Legend(_OF_PARTICLES))
        if any(one.gated is not None for one in found):
            notes.append(Legend(_OF_GATES))
        if any(one.weights is not None for one in found):
            notes.append(Legend(_OF_TAILS))
        if any(one.constants for one in found):
            notes.append(Legend(_OF_CONSTANTS))
        title = f"{self.log.model.name}: is the filter right?"
        return Table("innovations", title, "", columns, notes=notes)

    def _last_states(self) -> Table:
        columns = naming("state", self.log.model.states)
        for one in self.tracks:
            ends = map(with_error, one.mean[-1], one.deviation[-1])
            columns.append(texts(one.label, ends))
        return Table("last", "States at the last time step ± standard deviation", "", columns)

    def _constants(self) -> list[Table]:
        """Returns the table of constants that were found; none if all are known."""
        labels = [one.label for one in self.tracks for _ in one.constants]
        found = [constant for one in self.tracks for constant in one.constants]
        if not found:
            return []
        columns = [
            words("tracker", labels),
            words("constant", [each.name for each in found]),
            texts("value ± standard error", [with_error(each.value, each.error) for each in found]),
            texts("95 %", [between(each.low, each.high, each.value) for each in found]),
        ]
        return [Table("constants", "Constants of largest likelihood", "", columns)]


def _names(logs: Sequence[Log]) -> list[str]:
    """Names logs by their files, or by numbers where these are alike; empty if there is one."""
    if len(logs) == 1:
        return [""]
    stems = [Path(log.file[0]).stem if log.file else "" for log in logs]
    if len(set(stems)) < len(stems):
        return [str(number) for number in range(1, len(logs) + 1)]
    return stems


def store(
    folder: Path, answers: Sequence[LogAnswer], command: Any, provenance: Mapping[str, Any]
) -> Path:
    """Writes track.json and returns its path: what is said of each tracker, or of each log and
    tracker."""
    told: Any = {answer.name: _trackers(answer) for answer in answers}
    said = {"logs": told} if len(answers) > 1 else {"trackers": told[""]}
    return write_result(folder, NAME, SCHEMA, command, {**said, **provenance})


def write_page(
    folder: Path, answer: LogAnswer, provenance: Mapping[str, Any], *, figures: bool = True
) -> list[Path]:
    """Writes track.csv, track.html and its pictures, or track-NAME.csv and so on of one log of
    several; returns the files."""
    from ipe_bench.report.figures.log import draw_log

    log = answer.log
    readings = int(np.isfinite(log.z).sum())
    name = f"{NAME}-{answer.name}" if answer.name else NAME
    of = f"{log.model.name}, {answer.name}" if answer.name else log.model.name
    return write_files(
        folder,
        name,
        (f"{name}.csv", answer.table()),
        f"{of}: {_finding(answer)}",
        _facts(answer),
        answer.parts(),
        draw_log(log, answer.tracks, name) if figures else (),
        lead=(
            "A model fits if innovations (readings minus predictions) are as large as it predicts"
            " and do not resemble each other."
        ),
        facts=[f"{readings} readings at {log.model.epochs} time steps"],
        sources=read_from(provenance),
    )


def _trackers(answer: LogAnswer) -> dict[str, dict[str, Any]]:
    found = {}
    for one in answer:
        found[one.label] = {name: as_json(getattr(one, name)) for name in _STORED}
        constants = {each.name: as_json([each.value, each.error]) for each in one.constants}
        found[one.label]["constants"] = constants
    return found


def _finding(answer: LogAnswer) -> str:
    """Says whether the model fits the log by any tracker, and names the trackers of each
    verdict."""
    by_verdict: dict[str, list[str]] = {}
    for one in answer:
        if one.verdict != NO_VERDICT:
            by_verdict.setdefault(one.verdict, []).append(one.label)
    if not by_verdict:
        return "tracks"
    told = "; ".join(f"{enumerate_few(who)} {shown(word)}" for word, who in by_verdict.items())
    if CONSISTENT in by_verdict:
        return f"the model fits the log: {told}"
    return f"no tracker fits the log: {told}"


def _facts(answer: LogAnswer) -> list[str]:
    """States the numbers behind the verdict of the first tracker that is tested, filters before
    smoothers, and which trackers are smoothers."""
    told: list[str] = []
    tested = [one for one in answer if one.verdict != NO_VERDICT and np.isfinite(one.mean_nis)]
    for one in sorted(tested, key=lambda one: one.smooths)[:1]:
        low, high = map(short, one.limits)
        told.append(
            Fact(
                "Size of innovations",
                f"NIS / m of {one.label} is {short(one.mean_nis)}; {low} to {high} if the model is"
                " right.",
            )
        )
        if np.isfinite(one.white_p):
            alike = "no more than" if one.white_p >= FIT_LEVEL else "by more than"
            told.append(
                Fact(
                    "Successive innovations",
                    f"They resemble each other {alike} chance explains: p {p_value(one.white_p)}.",
                )
            )
    gated = [one for one in answer if one.share_gated > 0]
    if gated:
        share = percent(gated[0].share_gated)
        told.append(
            Fact("Left out", f"{share} of the readings, beyond the gate of {gated[0].label}.")
        )
    smoothers = [one.label for one in answer if one.smooths]
    if smoothers:
        use = f"{enumerate_few(smoothers)}: later readings count in their paths."
        told.append(Fact("Smoothers", use))
    return told
