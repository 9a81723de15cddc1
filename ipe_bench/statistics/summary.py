"""`summary.csv`: a row per scenario, estimator and parameter, plus the parameter `all`; its columns are those of
`records.all_statistics()`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.statistics.collect import ALWAYS_COLUMNS, Collection, Group, collect
from ipe_bench.statistics.comparisons import Outcomes, common, may_be_best
from ipe_bench.statistics.records import STATISTICS, all_statistics, frame_columns, summary_columns_of
from ipe_bench.statistics.sample import Sample, samples

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
    """The summary of everything stored under the directories; empty if there is nothing."""
    return to_frame(rows_of_all(collect(directories)))


def rows_of_all(collection: Collection) -> list[dict[str, Any]]:
    """The rows of the summary of a collection."""
    scenarios = collection.scenarios.values()
    return [row for groups in scenarios for row in scenario_rows(collection, groups, lambda *_: None)[0]]


def scenario_rows(
    collection: Collection, groups: Sequence[Group], also: Callable[[Sample, Outcomes], None]
) -> tuple[list[dict[str, Any]], dict[str, Outcomes]]:
    """The rows of one scenario, and what is compared of its estimators; `also` is called with each of their samples,
    which is not kept."""
    rows: list[dict[str, Any]] = []
    outcomes: dict[str, Outcomes] = {}
    for sample in samples(collection, groups):
        group = sample.group
        head = dict(group.columns) | {"estimator": group.estimator} | dict(group.options)
        labels = [{"parameter": p["name"], "unit": p["unit"]} for p in sample.parameters]
        labels.append({"parameter": ALL, "unit": "linear bound"})
        rows += [head | label | row for label, row in zip(labels, summary_columns_of(sample), strict=True)]
        outcomes[group.estimator] = outcomes_of(sample)
        also(sample, outcomes[group.estimator])
    if outcomes:
        paired = common(outcomes)
        best = may_be_best(np.column_stack([outcome.success for outcome in paired.values()]))
        marks = dict(zip(paired, best.tolist(), strict=True))
        for row in rows:
            row[BEST] = marks[row["estimator"]]
    return rows, outcomes


def outcomes_of(sample: Sample) -> Outcomes:
    """What comparisons and profiles need of a sample, by ascending seed and trial."""
    order = np.argsort(sample.number, kind="stable")
    columns = sample.number, sample.distance, sample.inside_gate, sample.cost
    return Outcomes(*(values[order] for values in columns))


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
