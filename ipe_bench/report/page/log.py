"""Tracks of real readings: tables, picture and files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.files import write_text
from ipe_bench.real.logs import SEARCHES, Log, LogTracks, far_below
from ipe_bench.report.page.answer import as_json, labelled, read_from, with_error
from ipe_bench.report.page.writer import write_files
from ipe_bench.report.tables.table import Part, Shown, Strong, Table, interval, texts, words
from ipe_bench.report.words import enumerate_few, p_value, short
from ipe_bench.statistics.verdicts import NO_VERDICT, shown

if TYPE_CHECKING:
    import pandas as pd

NAME, TABLE, SCHEMA = "track", "track.csv", 1


@dataclass(frozen=True)
class LogAnswer(Shown):
    """Holds the tracks of one log, one for each tracker."""

    log: Log
    tracks: Sequence[LogTracks]

    @property
    def passes(self) -> bool:
        """Whether the track of any tracker passes every test."""
        return any(one.passes for one in self.tracks)

    def __iter__(self) -> Iterator[LogTracks]:
        return iter(self.tracks)

    def __len__(self) -> int:
        return len(self.tracks)

    def __getitem__(self, which: str | int) -> LogTracks:
        """Returns the track at this label or place."""
        return labelled(self.tracks, [one.label for one in self.tracks], which)

    def table(self) -> pd.DataFrame:
        """Returns a row per tracker and epoch: each state and each predicted reading with its standard deviation, the
        readings, and NIS."""
        import pandas as pd

        model, frames = self.log.model, []
        for one in self.tracks:
            columns = {
                "tracker": one.label,
                "epoch": range(1, model.epochs + 1),
                "time [s]": model.times,
            }
            for i, state in enumerate(model.states):
                unit = f" [{state.unit}]" if state.unit else ""
                columns |= {
                    f"{state.name}{unit}": one.mean[:, i],
                    f"{state.name}_deviation{unit}": one.deviation[:, i],
                }
            for j, name in enumerate(model.reading_names):
                columns |= {
                    f"{name}_reading": self.log.z[:, j],
                    f"{name}_predicted": one.predicted[:, j],
                    f"{name}_predicted_deviation": one.predicted_deviation[:, j],
                }
            frames.append(pd.DataFrame(columns | {"nis": one.nis}))
        return pd.concat(frames, ignore_index=True)

    def parts(self) -> list[Part]:
        """Returns the test of the innovations of each tracker, and the states at the last epoch."""
        found, states = self.tracks, self.log.model.states
        limits = [one.limits[0] for one in found], [one.limits[1] for one in found]
        columns = [
            words("tracker", [one.label for one in found]),
            texts("NIS or cost / m", [short(one.mean_nis) for one in found]),
            interval("95 % if right", *limits, short),
            words("verdict", [shown(one.verdict) for one in found]),
            texts("fit p", [p_value(one.fit_p) for one in found]),
            texts("white p", [p_value(one.white_p) for one in found]),
            texts(
                "log likelihood", [f"{one.log_likelihood:.2f}".replace("nan", "-") for one in found]
            ),
        ]
        note = (
            "Innovations are readings less their predictions, in predicted standard deviations, and NIS / m is their"
            " mean square. A smoother has none: it is judged by the cost of its path, and one behind a filter by NIS"
            " and whiteness of that filter. If the model is right both are chi-square with a degree per reading, and"
            " fit p is the probability of larger ones. Innovations are white if the filter is right (Ljung and Box)."
            " The verdict is on innovations alone: an error that readings do not show, such as the turn of a whole map,"
            " leaves them as they are. A track is lost from the epoch from which most of them are larger than all but"
            " one in a million by chance. A dash: the tracker has none of it."
        )
        if np.isfinite([one.effective for one in found]).any():
            columns.append(texts("effective particles", [short(one.effective) for one in found]))
            note += (
                " Innovations of particles are by the mean and covariance of the readings that they predict; effective"
                " particles: 1 / sum of squared weights, the median of all epochs; collapsed: below 2."
            )
        if any(one.constants for one in found):
            note += (
                f" Constants have the largest likelihood that {SEARCHES} searches found. Since innovations determined"
                " them, the mean square of innovations hardly tests the model; whiteness does."
            )
        ends = [
            words("state", [state.name for state in states]),
            words("unit", [state.unit for state in states]),
        ]
        ends += [
            texts(one.label, map(with_error, one.mean[-1], one.deviation[-1])) for one in found
        ]
        constants = [(one.label, each) for one in found for each in one.constants]
        rows = [each for _, each in constants]
        maximum = [
            words("tracker", [label for label, _ in constants]),
            words("constant", [each.name for each in rows]),
            texts("value ± standard error", [with_error(each.value, each.error) for each in rows]),
            interval("95 %", [each.low for each in rows], [each.high for each in rows], short),
        ]
        return [
            *(
                Strong(f"{one.label}: {text}")
                for one in found
                for text in (one.message, *one.notes)
                if text
            ),
            *map(Strong, far_below(found)),
            *(
                [Table("constants", "Constants of largest likelihood", "", maximum)]
                if constants
                else ()
            ),
            Table(
                "innovations",
                f"{self.log.model.name}: is the filter right?",
                "",
                columns,
                notes=[note],
            ),
            Table("last", "States at the last epoch ± standard deviation", "", ends),
        ]


def write_tracks(
    folder: Path,
    answer: LogAnswer,
    command: Any,
    provenance: Mapping[str, Any],
    *,
    figures: bool = True,
) -> list[Path]:
    """Writes track.json, track.csv, track.html and the picture; returns the files."""
    from ipe_bench.report.figures.log import draw_log

    log, rows = (
        answer.log,
        ("lost_from", "effective", "message", "notes", "mean_nis", "limits", "verdict"),
    )
    rows = (*rows, "fit_p", "white_p", "log_likelihood", "passes")
    trackers = {one.label: {name: as_json(getattr(one, name)) for name in rows} for one in answer}
    for one in answer:
        trackers[one.label]["constants"] = {
            each.name: as_json([each.value, each.error]) for each in one.constants
        }
    content = {"schema": SCHEMA, "command": command, "trackers": trackers, **provenance}
    write_text(folder / f"{NAME}.json", json.dumps(content, indent=1) + "\n")
    facts = [f"{int(np.isfinite(log.z).sum())} readings at {log.model.epochs} epochs"]
    verdicts = dict.fromkeys(one.verdict for one in answer if one.verdict != NO_VERDICT)
    found = {
        word: enumerate_few([one.label for one in answer if one.verdict == word])
        for word in verdicts
    }
    listed = "; ".join(f"{who} {shown(word)}" for word, who in found.items())
    said = [f"Tested by innovations or the cost of a path: {listed}."] if found else []
    smoothers = [one.label for one in answer if one.smooths]
    if smoothers:
        said.append(f"Smoothers, which use later readings: {enumerate_few(smoothers)}.")
    told = {"facts": facts, "sources": read_from(provenance)}
    files = write_files(
        folder,
        NAME,
        (TABLE, answer.table()),
        f"{log.model.name}: tracks",
        said,
        answer.parts(),
        draw_log(log, answer.tracks) if figures else (),
        **told,
    )
    return [folder / f"{NAME}.json", *files]
