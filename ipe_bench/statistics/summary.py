"""`summary.csv`: a row per scenario, estimator and parameter, plus the parameter `all`; its columns are those of
`records.all_statistics()`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.statistics.collect import ALWAYS_COLUMNS, Collection, collect
from ipe_bench.statistics.comparisons import Outcomes, common, may_be_best
from ipe_bench.statistics.records import STATISTICS, all_statistics, frame_columns, gate_radius, summary_columns_of
from ipe_bench.statistics.sample import Sample, Shared

if TYPE_CHECKING:
    import pandas as pd

ALL = "all"
"""The row over all parameters."""
BEST = "may_be_best"
"""Whether no rival surely succeeds more often in the same trials; see `comparisons.may_be_best`."""
COLUMNS = (*frame_columns(STATISTICS), BEST)
"""The columns of our own statistics."""


def columns() -> tuple[str, ...]:
    """The columns of the statistics."""
    return (*frame_columns(all_statistics()), BEST)


def summarize(directories: Sequence[Path | str]) -> pd.DataFrame:
    """The tidy summary of everything stored under the directories; empty where there is nothing."""
    return summary_of(collect(directories))


def summary_of(collection: Collection) -> pd.DataFrame:
    """The tidy summary of a collection; empty where it is."""
    return to_frame(rows_of_all(collection))


def rows_of_all(collection: Collection) -> list[dict[str, Any]]:
    """The rows of the summary of a collection."""
    rows: list[dict[str, Any]] = []
    for groups in collection.scenarios.values():
        shared = Shared.among(collection, groups)
        own: list[dict[str, Any]] = []
        outcomes: dict[str, Outcomes] = {}
        for group in groups:
            sample = Sample.load(collection, group, shared)
            own += summary_rows(sample)
            outcomes[group.estimator] = outcomes_of(sample)
        mark_best(own, outcomes)
        rows += own
    return rows


def outcomes_of(sample: Sample) -> Outcomes:
    """What comparisons and profiles need of a sample, by ascending seed and trial."""
    success = sample.distance <= gate_radius(sample.n)
    values = (sample.number, sample.distance, success, sample.cost)
    if np.all(sample.number[1:] > sample.number[:-1]):
        return Outcomes(*values)
    order = np.argsort(sample.number, kind="stable")
    return Outcomes(*(v[order] for v in values))


def mark_best(rows: Sequence[dict[str, Any]], outcomes: Mapping[str, Outcomes]) -> None:
    """Adds the column `BEST` to the rows of one scenario, over the trials that all its estimators have."""
    paired = common({label: outcome for label, outcome in outcomes.items() if len(outcome.ids)})
    if not paired:
        return
    best = may_be_best(np.column_stack([outcome.success for outcome in paired.values()]))
    marks = dict(zip(paired, best.tolist(), strict=True))
    for row in rows:
        row[BEST] = marks[row["estimator"]]


def summary_rows(sample: Sample) -> list[dict[str, Any]]:
    """The rows of one scenario under one estimator; none where it has no trials."""
    if len(sample) == 0:
        return []
    group = sample.group
    head = dict(group.columns) | {"estimator": group.estimator} | dict(group.options)
    labels = [{"parameter": p["name"], "unit": p["unit"]} for p in sample.parameters]
    labels.append({"parameter": ALL, "unit": "linear bound"})
    return [head | label | row for label, row in zip(labels, summary_columns_of(sample), strict=True)]


def to_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Rows as a table, columns in the order that readers know."""
    import pandas as pd

    frame, known = pd.DataFrame(list(rows)), columns()
    if frame.empty:
        return pd.DataFrame(columns=[*ALWAYS_COLUMNS, "parameter", "unit", *known])
    keys = [c for c in frame.columns if c not in (*known, "parameter", "unit")]
    first = [c for c in ("measurement", "noise") if c in keys]
    last = ["error_scale", "estimator"]
    middle = [c for c in keys if c not in (*first, *last) and not c.startswith("estimator.")]
    options = [c for c in keys if c.startswith("estimator.")]
    return frame[[*first, *middle, *last, *options, "parameter", "unit", *known]]
