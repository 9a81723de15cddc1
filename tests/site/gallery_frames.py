"""Keeps what a page of the gallery is drawn from: frames of an analysis, and what its results say
of themselves.

Sentences, tables, captions and figures are not kept: they are drawn again by whoever builds the
site.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.basics.files import write_atomically
from ipe_bench.report.figures.views import FRAMES
from ipe_bench.runs.results import StoredCell
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.collect import Collection, Group
from ipe_bench.statistics.registry import add_statistics
from ipe_bench.statistics.statistic import ALL

SUFFIX = ".json.xz"
KEPT = ("summary", "scores", "pairs")
"""Frames of an analysis that pages are drawn from; all others are empty."""
_LEFT_OUT = ("libraries", "linear_bound", "source", "versions")
"""What a footer says that no page shows."""
_COLUMNS = ("status", "error_", "deviation_", "path_")
"""Columns of a single trial behind digits of certified answers and published errors, or what they
begin with."""


@dataclass
class Kept(Collection):
    """Holds results without their files: no trials but those of results with a single one."""

    rows: Mapping[str, Mapping[str, Sequence[Any]]] = field(default_factory=dict)
    """Columns of the trial of each result, by its key."""

    def load(self, cell: StoredCell, *_: Any) -> dict[str, Any]:
        return {name: np.array(values) for name, values in self.rows[cell.key].items()}


@dataclass(frozen=True)
class Computed:
    """Holds the results of an experiment, and says what computed them."""

    command: str
    version: str
    asked_results: int
    """Results that the experiment asks for: an estimator in a scenario each."""
    asked_trials: int
    """Trials that it asks for in each result."""
    analysis: Analysis

    @property
    def _totals(self) -> pd.DataFrame:
        summary = self.analysis.summary
        return summary[summary["parameter"] == ALL]

    @property
    def complete(self) -> bool:
        """Whether all that the experiment asks for is there."""
        return len(self._totals) >= self.asked_results and bool(
            (self._totals["trials"] >= self.asked_trials).all()
        )

    @property
    def extent(self) -> str:
        """Says how many of the trials and of the results that are asked for are there."""
        counts = self._totals["trials"]
        trials = " to ".join(dict.fromkeys(f"{count:,}" for count in (counts.min(), counts.max())))
        results = f"{len(self._totals):,} of {self.asked_results:,} results"
        return f"{trials} of {self.asked_trials:,} trials; {results}"

    def write(self, path: Path, *, parameters: bool) -> None:
        """Writes what pages are drawn from, with the rows of single `parameters` if they are."""
        frames = {name: getattr(self.analysis, name) for name in KEPT}
        if not parameters:
            frames["summary"] = self._totals
        groups = self.analysis.collection.groups
        content = {
            "command": self.command,
            "version": self.version,
            "asked_results": self.asked_results,
            "asked_trials": self.asked_trials,
            "frames": {name: frame.to_dict("list") for name, frame in frames.items()},
            "groups": [_described(group) for group in groups],
            "rows": {
                group.cells[0].key: _single(self.analysis.collection, group) for group in groups
            },
        }
        text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), default=_plain)
        write_atomically(
            path, lambda place: place.write_bytes(lzma.compress(text.encode(), preset=9))
        )


def read(path: Path) -> Computed:
    """Reads what `Computed.write` wrote: statistics of the bench alone, so that those of plugins
    are forgotten."""
    add_statistics([])
    content = json.loads(lzma.decompress(path.read_bytes()))
    groups = tuple(_group(one) for one in content["groups"])
    frames = {name: pd.DataFrame(content["frames"].get(name)) for name in FRAMES}
    collection = Kept((), groups=groups, rows=content["rows"])
    told = {name: content[name] for name in ("command", "version", "asked_results", "asked_trials")}
    return Computed(**told, analysis=Analysis(collection=collection, **frames))


def _described(group: Group) -> dict[str, Any]:
    footer = {name: value for name, value in group.footer.items() if name not in _LEFT_OUT}
    told = {"columns": dict(group.columns), "options": dict(group.options)}
    return {"estimator": group.estimator, **told, "footer": footer}


def _group(described: Mapping[str, Any]) -> Group:
    cell = StoredCell(described["footer"], ())
    return Group(
        described["columns"], described["estimator"], described["options"], (cell,), (None,)
    )


def _single(collection: Collection, group: Group) -> dict[str, list[Any]]:
    """Returns the columns of a result's only trial; empty of one with several."""
    cell = group.cells[0]
    if cell.trials > 1:
        return {}
    return {
        name: list(v)
        for name, v in collection.load(cell, None).items()
        if name.startswith(_COLUMNS)
    }


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else str(value)
