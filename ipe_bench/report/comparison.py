"""What `compare` found: tables, a CSV file and a page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.report.table import Table, texts, words
from ipe_bench.report.words import compact, duration, p_value, percent, plain
from ipe_bench.report.writer import write
from ipe_bench.statistics.between import NOT_SETTINGS, described

if TYPE_CHECKING:
    import pandas as pd


def contents(frame: pd.DataFrame, alpha: float) -> list[Table]:
    """A table per comparison, within 80 columns; what the columns mean stands below the last."""
    titles = ("", "first", "second", "change", f"{100 * (1 - alpha):g} %", "p", "e", "second is")
    tables = []
    for title, rows in _comparisons(frame):
        cells = list(zip(*map(_cells, rows), strict=True))
        last = len(titles) - 1
        columns = [(words if i in (0, last) else texts)(t, cells[i]) for i, t in enumerate(titles)]
        needed = [_needed(row) for row in rows if row.get("power", math.nan) > 0]
        tables.append(Table("comparison", title, "", columns, notes=needed))
    note = (
        "error is the mean Mahalanobis error, where a trial counts as at most the radius of the gate of success; cost"
        " counts simulations. p comes from McNemar's exact test for success and from random signs for ratios, with"
        " Holm's correction over all rows. e is evidence that may be looked at repeatedly; e = 20 is as rare as p ="
        " 0.05. Each interval is that of its row alone. Times are not tested."
    )
    if (frame["matched_by"] == "order").any():
        note += " Without common trials nothing is gained from pairing: the intervals are wider."
    return [*tables[:-1], *(replace(last, notes=[*last.notes, note]) for last in tables[-1:])]


def _needed(row: dict[str, Any]) -> str:
    return (
        f"{row['trials_needed']:,} trials find a difference of {100 * row['difference']:g} % in success with a"
        f" probability of {100 * row['power']:g} %: one alone succeeds in {row['discordant']} of {row['trials']}"
        f" trials, so in at most {percent(row['discordant_high'])} of all (80 % limit)."
    )


def _comparisons(frame: pd.DataFrame) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Each comparison with its title, in order."""
    settings = [c for c in frame.columns if c not in NOT_SETTINGS]
    listed: list[Any] = frame.to_dict("records")
    for _, part in groupby(listed, key=lambda row: tuple(plain(row[c]) for c in (*settings, "first", "second"))):
        rows = list(part)
        first = rows[0]
        who = first["first"] if first["first"] == first["second"] else f"{first['first']}, then {first['second']}"
        how = "trials" if first["matched_by"] == "trial" else "trials of other seeds, matched in their order"
        yield f"{described(first)}: {who}; {first['trials']} {how}", rows


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    quantity = row["quantity"]
    show = {"success": percent, "time": lambda v: duration(v, 2)}.get(quantity, compact)
    if quantity == "success":
        change, ends = f"{100 * row['change']:+.1f} %", f"{100 * row['low']:+.1f} to {100 * row['high']:+.1f}"
    else:
        change, ends = _ratio(row["change"]), f"{_ratio(row['low'])} to {_ratio(row['high'])}"
    p, e = row["p"], row["e"]
    return (
        *(quantity, show(row["first_value"]), show(row["second_value"]), change),
        ends if math.isfinite(row["low"]) else "-",
        p_value(p) if math.isfinite(p) else "",
        compact(e) if math.isfinite(e) else "",
        row["finding"] or ("-" if quantity != "time" else ""),
    )


def _ratio(value: float) -> str:
    return f"{value:.3f}" if 0.1 <= value < 9.9995 else compact(value)


def write_comparison(frame: pd.DataFrame, output: Path, alpha: float) -> list[Path]:
    """Writes comparison.csv and a page of all tables; returns the files."""
    return write(output, "comparison", "Comparison", contents(frame, alpha), table=("comparison.csv", frame))
