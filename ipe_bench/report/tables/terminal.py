"""Shows the summary as tables in a terminal; a narrow one omits columns from the right, never the names."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ipe_bench.report.tables.table import (
    Cell,
    Column,
    Part,
    Table,
    column,
    interval,
    sort_key,
    words,
)
from ipe_bench.report.words import (
    brief,
    cost,
    duration,
    ends_in_percent,
    p_value,
    percent,
    scientific,
    short,
    value_text,
)
from ipe_bench.statistics.formulas import CAP
from ipe_bench.statistics.records import SCORES
from ipe_bench.statistics.registry import all_statistics, summary_columns
from ipe_bench.statistics.statistic import ALL, BEST, Kind, Statistic, Where
from ipe_bench.statistics.verdicts import VERDICTS, shown, sign_of

_MOST_LINES = 75, 50
"""Lines that a terminal shows of one setting, and of several: about two screens with what stands below."""
_HEAD = 4
"""Lines of a table besides its rows and the blank one after each error scale."""
_WIDE_ENOUGH = 100
"""Letters of a screen with room for failures, and for verdicts spelt out."""
_LEGEND = (
    "success: % of all trials (95 % interval; bold: no other succeeds significantly more often; nothing is bold where"
    " this holds of all){failed}; error: median / 95 % quantile over {reference}; efficiency and NEES (median): 1 is"
    " right{sign}; cost: simulations of a trial, median/mean where they differ; time: mean of a trial. More: ipe-bench"
    " list statistic."
)
_FAILED = "; failed: known / silent"
_SIGNS = (
    "; verdict: is the reported covariance right, by the mean NEES of the converged trials",
    f", {', '.join(f'{word.sign} {word.shown}' for word in VERDICTS[:4])}",
)
_TOLD = (
    "With noise=unknown every estimator here is given R, that of the true levels at the nominal readings; bounds and"
    " success are those of parameters that are estimated together with the levels."
)
TRACKED = (
    "For states that move, all of this is of the last epoch, where filters and smoothers have the same readings:"
    " success is the share of trials whose error there lies within all but one in a million of the covariance of the"
    " filter linearised at the true path. The whole path is in the table of all epochs, where filters and smoothers"
    " have bounds of their own. Cost counts evaluations of transition and reading."
)
"""References of a track's errors."""


def overview_notes(noises: Collection[str], *, narrow: bool = False) -> tuple[str, ...]:
    """Explains the columns of the overview, and what estimators assume about these noises."""
    reference = "the linearised filter" if set(noises) == {"model"} else "the bound"
    legend = _LEGEND.format(
        failed="" if narrow else _FAILED, reference=reference, sign=_SIGNS[narrow]
    )
    return (
        legend,
        *(words for noise, words in (("unknown", _TOLD), ("model", TRACKED)) if noise in noises),
    )


def summary_tables(
    listed: Sequence[Mapping[str, Any]], totals: Sequence[Table], width: int
) -> list[Part]:
    """Returns a table per setting (measurement, noise, differing options), after the totals of certified runs."""
    # Models whose own readings are certified, without being of a collection, have no totals.
    rows = [
        row
        for row in listed
        if row["parameter"] == ALL and not (totals and row["noise"] == "certified")
    ]
    known = {*summary_columns(), "parameter", "unit", "estimator", "error_scale"}
    columns = dict.fromkeys(
        c for row in rows for c in row if c not in known and not c.startswith("estimator.")
    )
    settings: dict[str, list[Any]] = {}
    for row in rows:
        # An option that the class lacks is left out.
        named = {k: value_text(row.get(k)) for k in columns if value_text(row.get(k)) != "-"}
        title = ", ".join(
            v if k in ("measurement", "noise") else f"{k}={v}" for k, v in named.items()
        )
        settings.setdefault(title, []).append(row)
    kept = {title: part for title, part in _shortened(settings).items() if part}
    tables = [_setting(title, part, width) for title, part in kept.items()]
    if tables:
        tables[-1] = replace(
            tables[-1],
            notes=overview_notes({row["noise"] for row in rows}, narrow=width < _WIDE_ENOUGH),
        )
    further, hidden = len(rows) - sum(map(len, kept.values())), len(settings) - len(kept)
    whole = f", {hidden} of {len(settings)} settings whole" if hidden else ""
    left_out = f"{further} of {len(rows)} rows are left out here{whole}; summary.csv and report.html have all."
    return [*totals, *tables, *([left_out] if further else [])] or ["no trial is stored yet"]


def _shortened(settings: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Returns the rows of each setting, in order, until the screen is full; of one that does not fit, those of error
    scales evenly between both ends."""
    room, kept = _MOST_LINES[len(settings) > 1], {}
    for title, rows in settings.items():
        scales = list(dict.fromkeys(row["error_scale"] for row in rows))
        count = max(not kept, int((room - _HEAD) / (len(rows) / len(scales) + 1)))
        if count < len(scales):
            scales = [scales[i * (len(scales) - 1) // max(1, count - 1)] for i in range(count)]
        kept[title] = [row for row in rows if row["error_scale"] in scales]
        room -= _HEAD + len(kept[title]) + len(scales)
    return kept


def _setting(title: str, rows: Sequence[Mapping[str, Any]], width: int) -> Table:
    scales = column("scale", [row["error_scale"] for row in rows], lambda v: f"{v:g}")
    columns = [
        scales,
        *overview_columns(rows, leading(rows, ["error_scale"]), narrow=width < _WIDE_ENOUGH),
    ]
    # The number of trials stands in the title if it is the same for all.
    counts = sorted({row["trials"] for row in rows})
    # A narrow screen leaves out the last columns: cost and time before what a plugin was asked to show.
    columns[-2:-2] = statistics("terminal", rows)
    if len(counts) > 1:
        columns.append(column("trials", [row["trials"] for row in rows], str))
    else:
        title = f"{title}: {counts[0]} trial{'s' * (counts[0] != 1)} per row"
    return Table("summary", title, "", columns, grouped=1, whole="summary.csv")


def leading(rows: Sequence[Mapping[str, Any]], scenario: Sequence[str]) -> list[bool]:
    """Returns whether each row's estimator may be the best of its scenario, if another one is surely beaten."""
    keys = [tuple(str(row[name]) for name in scenario) for row in rows]
    beaten = {key for key, row in zip(keys, rows, strict=True) if not row[BEST]}
    return [bool(row[BEST]) and key in beaten for key, row in zip(keys, rows, strict=True)]


def overview_columns(
    rows: Sequence[Mapping[str, Any]], best: Sequence[bool], *, narrow: bool = False
) -> list[Column]:
    """Returns the columns over all trials for every estimator; a narrow screen has no failures and short verdicts."""

    def cells(
        title: str, key: str, show: Callable[[Mapping[str, Any]], str], best: Sequence[bool] = ()
    ) -> Column:
        marks = best or [False] * len(rows)
        return Column(
            title,
            [Cell(show(r), sort_key(r[key]), mark) for r, mark in zip(rows, marks, strict=True)],
        )

    def points(share: float) -> str:
        return percent(share).removesuffix(" %")

    def success(row: Mapping[str, Any]) -> str:
        return f"{points(row['success'])} ({'-'.join(ends_in_percent(row['success_low'], row['success_high']))})"

    def efficiency(row: Mapping[str, Any]) -> str:
        # Where half of the trials are capped, it is a limit and no value.
        return f"{'<' * (row['error_median'] > CAP)}{row['efficiency_capped']:.2f}"

    slash = "/" if narrow else " / "

    def verdict(row: Mapping[str, Any]) -> str:
        return sign_of(row["verdict"]) if narrow else shown(row["verdict"])

    def failed(row: Mapping[str, Any]) -> str:
        return f"{points(row['failed_known'])} / {points(row['failed_silent'])}"

    return [
        words("estimator", [row["estimator"] for row in rows], best),
        cells("success", "success", success, best),
        *([] if narrow else [cells("failed", "failed_silent", failed)]),
        cells(
            "error",
            "error_median",
            lambda r: f"{brief(r['error_median'])}{slash}{brief(r['error_q95'])}",
        ),
        cells("eff." if narrow else "efficiency", "efficiency_capped", efficiency),
        cells(
            "NEES",
            "nees_median",
            lambda r: f"{brief(r['nees_median'])} {verdict(r) * narrow}".strip(),
        ),
        *([] if narrow else [words("verdict", map(verdict, rows))]),
        cells(
            "cost",
            "simulations_median",
            lambda r: cost(r["simulations_median"], r["simulations_mean"]),
        ),
        cells("time", "time_mean_s", lambda r: duration(r["time_mean_s"], 2)),
    ]


# Statistics ----------------------------------------------------------------------------------------------------------


def statistics(where: Where, rows: Sequence[Mapping[str, Any]]) -> list[Column]:
    """Returns the columns of the statistics that are shown in that table."""
    columns: list[Column] = []
    for record in (*all_statistics(), *SCORES):
        if where not in record.where or not reported(record, rows):
            continue
        numeric, show = record.kind != "word", _shower(record.kind, where)
        cells = [
            Cell(_shown(record, where, row), sort_key(row[record.name]) if numeric else None)
            for row in rows
        ]
        columns.append(Column(record.titles.get(where, record.title), cells, numeric))
        if where in record.limits_titles:
            low, high = (
                [row[name] if _applies(record, where, row) else math.nan for row in rows]
                for name in record.columns[1:]
            )
            columns.append(interval(record.limits_titles[where], low, high, show))
    return columns


def reported(record: Statistic, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Returns whether a table has a statistic's column; a rare one needs a finite value, a rare count one above 0."""
    values = [row[record.name] for row in rows]
    return not record.rare or any(
        math.isfinite(v) and (v > 0 or record.kind != "count") for v in values
    )


def _shown(record: Statistic, where: Where, row: Mapping[str, Any]) -> str:
    """Formats a value in a table, with the number of trials behind it unless that is all."""
    if not _applies(record, where, row):
        return "-"
    text = _shower(record.kind, where)(row[record.name])
    if record.given and text != "-" and row[record.count] < row["trials"]:
        text += f" ({int(row[record.count])})"
    return text


def _applies(record: Statistic, where: Where, row: Mapping[str, Any]) -> bool:
    """Returns whether a row can have the statistic: an estimator that solves no equation has no solved trials. In the
    tables of parameters and of states its finished trials stand in for them."""
    return record.given != "solved" or where in ("parameters", "tracks") or row["equation"] != "-"


def _shower(kind: Kind, where: Where) -> Callable[[Any], str]:
    """Returns the formatter of values of that kind in that table."""
    return {
        "count": lambda v: f"{int(v):d}" if math.isfinite(v) else "-",
        "share": percent,
        "number": short,
        # Physical units are of any size.
        "physical": (lambda v: scientific(v) if math.isfinite(v) else short(v))
        if where == "parameters"
        else short,
        "seconds": (lambda v: duration(v, 2)) if where == "terminal" else duration,
        "probability": p_value,
        "word": shown,
    }[kind]
