"""Shows the summary as tables in a terminal; a narrow one omits columns from the right, never the names."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from ipe_bench.report.finding import FAILS, Finding
from ipe_bench.report.tables.matrix import opening
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
    varying,
)
from ipe_bench.statistics.formulas import CAP
from ipe_bench.statistics.records import SCORES
from ipe_bench.statistics.registry import all_statistics, summary_columns
from ipe_bench.statistics.statistic import ALL, BEST, Kind, Statistic, Where
from ipe_bench.statistics.verdicts import VERDICTS, shown, sign_of

MOST_SETTINGS = 2
"""Differing settings that have a column each."""
_MOST_LINES = 46
"""Lines that a terminal shows of several settings, most of them of matrices."""
_HEAD = 4
"""Lines of a table besides its rows."""
_WIDE_ENOUGH = 100
"""Letters of a screen with room for failures, and for verdicts spelt out."""
_LEGEND = (
    "success: % of all trials (95 % interval); bold: not significantly worse than the best, unless this holds for all"
    "{failed}; error: median / 95 % quantile over {reference}; efficiency, NEES (median): 1 is ideal{sign}; cost:"
    " simulations of a trial, median/mean if they differ; time: mean of a trial. More: ipe-bench list statistic."
)
_FAILED = "; failed: known / undetected, %"
_SIGNS = (
    "; verdict: is the reported covariance right?",
    f", {', '.join(f'{word.sign} {word.shown}' for word in VERDICTS[:4])}",
)
_TOLD = (
    "With noise=unknown every estimator here assumes R with the true levels at the nominal readings; bounds and success"
    " hold for parameters that are estimated together with the levels."
)
TRACKED = (
    "States that move: all columns hold at the last epoch, where filters and smoothers have the same readings. Success:"
    " the error lies in the gate (all but one in a million) of a filter linearised at the true path. The table of all"
    " epochs has the whole path. Cost: evaluations of transition and reading."
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
    opened = _opening(rows, list(columns))
    return [*totals, *opened, *tables, *([left_out] if further else [])] or [
        "no trial is stored yet"
    ]


def _opening(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> list[Part]:
    """Returns the finding and its matrices, of constants and then of states that move."""
    simulated = [row for row in rows if row["noise"] != "certified"]
    frame = pd.DataFrame(simulated)
    settings = differing(frame, columns) if simulated else []
    told = [{**row, "setting": text} for row, text in zip(simulated, settings, strict=True)]
    moving = [row for row in told if row["noise"] == "model"]
    constant = [row for row in told if row["noise"] != "model"]
    parts = [one for one in (constant, moving) if one]
    return [part for one in parts for part in opening(one, 0.6 * _MOST_LINES)]


def _shortened(settings: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Returns the rows of each setting at its telling scale, until the screen is full."""
    room, kept = 0.4 * _MOST_LINES, dict[str, list[Any]]()
    for title, rows in settings.items():
        here = _telling(rows)
        if kept and len(here) + _HEAD > room:
            break
        kept[title] = here
        room -= len(here) + _HEAD
    return kept


def _telling(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Returns the rows, the best first, of the largest scale at which most estimators may hold, or else of the last."""
    finding = Finding.of(rows)
    best_first = [one.label for one in finding.standings]
    scale = finding.places[-1][1]
    for at, (_, place) in enumerate(finding.places):
        possible = sum(one.judged[at] != FAILS for one in finding.standings)
        scale = place if 2 * possible > len(best_first) else scale
    here = [row for row in rows if row["error_scale"] == scale]
    return sorted(here, key=lambda row: best_first.index(row["estimator"]))


def _setting(title: str, rows: Sequence[Mapping[str, Any]], width: int) -> Table:
    best = leading(rows, ["error_scale"])
    columns = overview_columns(rows, best, narrow=width < _WIDE_ENOUGH)
    # The number of trials stands in the title if it is the same for all.
    counts = sorted({row["trials"] for row in rows})
    # A narrow screen leaves out the last columns: cost and time before what a plugin was asked to show.
    columns[-2:-2] = statistics("terminal", rows)
    if len(counts) > 1:
        columns.append(column("trials", [row["trials"] for row in rows], str))
    else:
        title = f"{title}: {counts[0]} trial{'s' * (counts[0] != 1)} per row"
    title += f" at error scale {value_text(rows[0]['error_scale'])}"
    return Table("summary", title, "", columns, whole="summary.csv")


def differing(rows: pd.DataFrame, columns: Sequence[str]) -> list[str]:
    """Returns for each row those of its settings that differ among the rows, of many those other than the most frequent
    ones; a dash if there are none."""
    apart = varying(columns, rows)
    if not apart:  # a frame without columns loses its rows in pandas 2.2
        return ["-"] * len(rows)
    values = rows[apart].map(value_text)
    usual = {c: values[c].mode().iloc[0] for c in values if len(values.columns) > MOST_SETTINGS}
    told = (
        [(c, v) for c, v in row.items() if v not in ("-", usual.get(c))]
        for row in values.to_dict("records")
    )
    return [
        ", ".join(v if c in ("measurement", "noise") else f"{c}={v}" for c, v in each) or "-"
        for each in told
    ]


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
