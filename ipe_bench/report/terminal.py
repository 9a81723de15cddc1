"""The summary as a table in the terminal, readable in 100 columns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from ipe_bench.report.words import compact, plain, shower
from ipe_bench.statistics.records import STATISTICS, Statistic
from ipe_bench.statistics.summary import ALL, COLUMNS

if TYPE_CHECKING:
    from rich.console import Group

_SHOWN = tuple(record for record in STATISTICS if "terminal" in record.where)
_NOT_SETTINGS = {*COLUMNS, "parameter", "unit", "estimator", "error_scale"}


def render(summary: pd.DataFrame, certified: pd.DataFrame | None = None) -> Group:
    """One table per setting (measurement, noise, and every option that differs), a section per error scale.

    Runs on certified readings, whose mean digits are in `certified`, share one table instead.
    """
    from rich import box
    from rich.console import Group
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    digits = [] if certified is None or certified.empty else _digits(certified)
    rows = summary[(summary["parameter"] == ALL) & (summary["noise"] != "certified")] if len(summary) else summary
    if rows.empty:
        return Group(*digits or [Text("nothing is stored yet")])
    columns = [c for c in rows.columns if c not in _NOT_SETTINGS and not c.startswith("estimator.")]
    parts: list[Any] = []
    for values, part in rows.groupby(columns, dropna=False, sort=False):
        named = dict(zip(columns, values if isinstance(values, tuple) else (values,), strict=True))
        title = ", ".join(
            str(v) if k in ("measurement", "noise") else f"{k}={plain(v)}" for k, v in named.items() if _says(v)
        )
        counts = part["trials"].unique()
        alike = len(counts) == 1
        if alike:
            title += f": {counts[0]} trials per row"
        table = Table(
            title=escape(title),
            title_justify="left",
            title_style="bold",
            box=box.SIMPLE_HEAD,
            padding=(0, 1),
            pad_edge=False,
            collapse_padding=True,
        )
        table.add_column("scale", justify="right", no_wrap=True)
        table.add_column("estimator", overflow="fold", min_width=12)
        # The number of trials stands in the title where it is the same for all.
        shown = [record for record in _SHOWN if not (alike and record.name == "trials")]
        for heading in _headings(shown):
            table.add_column(heading, justify="right", no_wrap=True)
        for scale, block in part.groupby("error_scale", sort=False):
            for i, (_, row) in enumerate(block.iterrows()):
                table.add_row(f"{scale:g}" if i == 0 else "", escape(str(row["estimator"])), *_cells(shown, row))
            table.add_section()
        parts.append(table)
    note = (
        "rmse/bound: root mean square error of the solved trials over the linear bound, all parameters, with its 95 %"
        " bootstrap interval. solved, success: of all trials. NEES: 1 where the reported covariance is right."
        " misfit: trials whose residuals fail the chi-square test at 0.1 %. sims, time: medians per trial, a"
        " Jacobian counting as one simulation per parameter."
    )
    return Group(*digits, *parts, Text(note, style="dim"))


def _says(value: Any) -> bool:
    """Whether a setting is spoken of in a title: not where it is absent, as an option of another class is."""
    return value is not None and not (isinstance(value, float) and math.isnan(value))


def _digits(averages: pd.DataFrame) -> list[Any]:
    """Mean correct digits on certified readings."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title="Certified readings", title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False
    )
    table.add_column("estimator")
    for name in ("start", "data sets", "solved", "digits", "of deviations", "of residuals", "deviations to 6 digits"):
        table.add_column(name, justify="right")
    for row in averages.sort_values(["mean_lre_parameters", "start"], ascending=False).itertuples():
        means = (row.mean_lre_parameters, row.mean_lre_deviations, row.mean_lre_rss)
        counts = (row.start, row.datasets, row.solved)
        table.add_row(
            str(row.estimator), *map(str, counts), *(f"{v:.2f}" for v in means), str(row.deviations_to_6_digits)
        )
    note = (
        "digits: log relative error against the certified answer, the fewest over a data set's parameters, at most 11,"
        " averaged over the data sets. solved: four digits or more."
    )
    return [table, Text(note, style="dim"), Text()]


def _headings(records: Sequence[Statistic]) -> Iterator[str]:
    for record in records:
        yield record.titles.get("terminal", record.title)
        if "terminal" in record.limits_titles:
            yield record.limits_titles["terminal"]


def _cells(records: Sequence[Statistic], row: Any) -> Iterator[str]:
    for record in records:
        yield shower(record.kind, "terminal")(row[record.name])
        if "terminal" in record.limits_titles:
            low, high = (row[name] for name in record.columns[1:])
            yield f"{compact(low)}-{compact(high)}" if math.isfinite(low) else "-"
