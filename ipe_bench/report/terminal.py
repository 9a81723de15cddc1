"""The summary as tables in the terminal: where it is narrow, columns go from the right, never the names."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ipe_bench.report.table import Column, Table, column, terminal, texts, words
from ipe_bench.report.words import compact, limits, plain, reported, shown
from ipe_bench.statistics.records import Statistic, all_statistics
from ipe_bench.statistics.summary import ALL
from ipe_bench.statistics.summary import columns as summary_columns

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group

WIDE = 120


def render(
    summary: pd.DataFrame | Sequence[Mapping[str, Any]],
    certified: pd.DataFrame | None = None,
    width: int = WIDE,
    attained: pd.DataFrame | None = None,
) -> Group:
    """One table per setting (measurement, noise, and every option that differs), a section per error scale.

    `summary` is the frame or its rows. Columns that do not fit the width are left out, and named below. Runs on
    certified readings, whose mean digits are in `certified`, share one table instead, and so do those on problems of
    known minimum, whose totals are in `attained`.
    """
    tables = [] if certified is None or certified.empty else [_digits(certified)]
    tables += [] if attained is None or attained.empty else [_attained(attained)]
    listed: list[Any] = list(summary) if isinstance(summary, Sequence) else [*summary.to_dict("records")]
    tables += _settings([row for row in listed if row["parameter"] == ALL and row["noise"] != "certified"])
    return terminal(tables or ["nothing is stored yet"], width)


def _settings(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """A table for each setting; what its columns mean stands below the last."""
    known = {*summary_columns(), "parameter", "unit", "estimator", "error_scale"}
    columns = dict.fromkeys(c for row in rows for c in row if c not in known and not c.startswith("estimator."))
    settings: dict[str, list[Any]] = {}
    for row in rows:
        named = {k: row.get(k) for k in columns}
        title = ", ".join(
            str(v) if k in ("measurement", "noise") else f"{k}={plain(v)}" for k, v in named.items() if _says(v)
        )
        settings.setdefault(title, []).append(row)
    tables = [_setting(title, part) for title, part in settings.items()]
    if tables:
        tables[-1] = replace(tables[-1], notes=[_legend(rows)])
    return tables


def _legend(rows: Sequence[Mapping[str, Any]]) -> str:
    return (
        "efficiency: the bound that applies over the root mean square error, 1 at best, with its 95 % bootstrap"
        " interval: of the solved trials (their number in brackets where it is not all), and of all. Filters and the"
        " linear estimate solve no equation. NEES: 1 where the reported covariance is right. misfit: trials whose"
        " residuals fail the test of fit at 0.1 %. "
        + ("ambiguous: several minima fit. " if any(math.isfinite(row["ambiguous"]) for row in rows) else "")
        + "sims, time: medians per trial, a Jacobian counting what it costs."
    )


def _setting(title: str, part: Sequence[Mapping[str, Any]]) -> Table:
    """The table of one setting."""
    # The number of trials stands in the title where it is the same for all.
    counts = list({row["trials"] for row in part})
    alike = len(counts) == 1
    records = [record for record in all_statistics() if "terminal" in record.where]
    columns = [
        column("scale", [row["error_scale"] for row in part], lambda v: f"{v:g}"),
        words("estimator", [row["estimator"] for row in part]),
    ]
    for record in records:
        if not (alike and record.name == "trials") and reported(record, part):
            columns += _statistic(record, part)
    title = f"{title}: {counts[0]} trial{'s' * (counts[0] != 1)} per row" if alike else title
    return Table("summary", title, "", columns, grouped=1, whole="summary.csv")


def _statistic(record: Statistic, part: Sequence[Mapping[str, Any]]) -> Iterator[Column]:
    """The column of a statistic, and that of its interval where it has one."""
    yield texts(record.titles.get("terminal", record.title), [shown(record, "terminal", row) for row in part])
    if "terminal" in record.limits_titles:
        ends = [limits(record, "terminal", row) for row in part]
        written = [f"{compact(low)}-{compact(high)}" if math.isfinite(low) else "-" for low, high in ends]
        yield texts(record.limits_titles["terminal"], written)


def _says(value: Any) -> bool:
    """Whether a setting is spoken of in a title: not where it is absent, as an option of another class is."""
    return value is not None and not (isinstance(value, float) and math.isnan(value))


def _digits(averages: pd.DataFrame) -> Table:
    """Mean correct digits on certified readings."""
    rows = averages.sort_values(["mean_lre_parameters", "start"], ascending=False)
    columns = [
        words("estimator", rows["estimator"]),
        *(
            column(title, rows[name], str)
            for name, title in (("start",) * 2, ("datasets", "data sets"), ("solved",) * 2)
        ),
        column("digits", rows["mean_lre_parameters"], lambda v: f"{v:.2f}"),
        column("of deviations", rows["mean_lre_deviations"], lambda v: f"{v:.2f}"),
        column("of residuals", rows["mean_lre_rss"], lambda v: f"{v:.2f}"),
        column("deviations to 6 digits", rows["deviations_to_6_digits"], str),
    ]
    note = (
        "digits: log relative error against the certified answer, the fewest over a data set's parameters, at most 11,"
        " averaged over the data sets. solved: four digits or more."
    )
    return Table(
        "certified_averages",
        "Certified readings",
        "",
        columns,
        notes=[note, ""],
        whole="tables/certified_averages.csv",
    )


def _attained(totals: pd.DataFrame) -> Table:
    """Problems of known minimum that are solved."""
    from ipe_bench.report.certified_tables import attained_columns

    columns = attained_columns(totals.sort_values("solved", ascending=False, kind="stable", ignore_index=True))
    note = (
        "solved: the estimate's sum of squares is the least known one, to 1e-6; converged: of these, where the status"
        " says so; elsewhere: converged and not solved. median cost: simulations, infinite where unsolved. in 10:"
        " solved within 10 (n + 1) simulations."
    )
    return Table("attained", "Known minima", "", columns, notes=[note, ""], whole="tables/attained.csv")
