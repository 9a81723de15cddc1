"""Everything the report is made of, computed from directories one scenario at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.statistics.collect import Collection, Group, collect
from ipe_bench.statistics.intervals import bootstrap_rms
from ipe_bench.statistics.summary import Sample, common_trials, summary_rows, to_frame
from ipe_bench.statuses import Status


@dataclass(frozen=True)
class Analysis:
    """Tables that figures, tables and the page are drawn from; all but `summary` have the same scenario columns."""

    collection: Collection
    summary: pd.DataFrame
    by_group: pd.DataFrame
    """Root mean square of error over linear bound per group of parameters, with its bootstrap interval."""
    endings: pd.DataFrame
    """How trials ended that did not converge: status, message, number, and the first such trial."""

    @property
    def problems(self) -> tuple[str, ...]:
        return tuple(self.collection.problems)

    @property
    def setting_columns(self) -> list[str]:
        """The columns that tell scenarios apart, but for the error scale."""
        first = self.collection.groups[0].columns if self.collection.groups else {}
        return [c for c in first if c != "error_scale"]


def analyse(directories: Sequence[Path | str]) -> Analysis:
    """Reads what is stored under the directories and computes all statistics.

    Raises:
        UserError: a directory does not exist.
    """
    collection = collect(directories)
    rows: list[dict[str, Any]] = []
    by_group: list[dict[str, Any]] = []
    endings: list[dict[str, Any]] = []
    for groups in collection.scenarios.values():
        common = common_trials(collection, groups)
        for group in groups:
            sample = Sample.load(collection, group, optional=["message"])
            rows += summary_rows(sample, common)
            by_group += _group_rows(sample)
            endings += _ending_rows(sample)
    return Analysis(collection, to_frame(rows), pd.DataFrame(by_group), pd.DataFrame(endings))


def head(group: Group) -> dict[str, Any]:
    return dict(group.columns) | {"estimator": group.estimator}


def _group_rows(sample: Sample) -> list[dict[str, Any]]:
    """Per group of parameters, in the order of the parameters; the group's bound is one in these units."""
    members: dict[str, list[int]] = {}
    for i, parameter in enumerate(sample.parameters):
        members.setdefault(parameter.get("group") or parameter["name"], []).append(i)
    rows = []
    solved = sample.solved
    squares = np.where(solved[:, None], sample.normalised, 0.0) ** 2
    for name, which in members.items():
        mean = squares[:, which].mean(axis=1, keepdims=True)
        low, high = bootstrap_rms(mean, solved)
        rmse = float(np.sqrt(mean[solved].mean())) if solved.any() else np.nan
        rows.append(head(sample.group) | {"group": name, "rmse": rmse, "low": low[0], "high": high[0]})
    return rows


def _ending_rows(sample: Sample) -> list[dict[str, Any]]:
    at = np.flatnonzero(~sample.converged)
    messages = sample.scalars.get("message")
    counts: Counter[tuple[str, str]] = Counter()
    first: dict[tuple[str, str], str] = {}
    for i in at:
        message = "" if messages is None or messages[i] is None else str(messages[i])
        ending = (str(sample.scalars["status"][i]), message)
        counts[ending] += 1
        first.setdefault(ending, f"seed {sample.ids[i, 0]}, trial {sample.ids[i, 1]}")
    return [
        head(sample.group)
        | {
            "status": status,
            "message": message or _reason(status),
            "trials": count,
            "share": count / len(sample),
            "first": first[status, message],
        }
        for (status, message), count in counts.most_common(20)
    ]


def _reason(status: str) -> str:
    reasons = {s.label: s.reason for s in Status}
    return reasons.get(status, "")
