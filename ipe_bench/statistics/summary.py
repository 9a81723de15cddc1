"""`summary.csv`: a row per scenario, estimator and parameter, plus the parameter `all`; its columns are those of
`records.all_statistics()`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ipe_bench.statistics.collect import ALWAYS_COLUMNS
from ipe_bench.statistics.records import STATISTICS, all_statistics, frame_columns, summary_columns_of
from ipe_bench.statistics.sample import Sample

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


def summary_rows(sample: Sample) -> list[dict[str, Any]]:
    """The rows of an estimator on a scenario, without the comparison with its rivals."""
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
