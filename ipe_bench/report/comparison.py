"""What `compare` found: tables, a CSV file, and a figure of all changes with their intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, house_style
from ipe_bench.report.table import Table, texts, words
from ipe_bench.report.words import compact, duration, p_value, percent, plain
from ipe_bench.report.writer import write
from ipe_bench.statistics.between import NOT_SETTINGS, described

if TYPE_CHECKING:
    import pandas as pd

_COLORS = {"better": "#009E73", "worse": "#D55E00", "": BOUND_COLOR}
MOST_ROWS = 40
"""Comparisons that the figure shows; the CSV file has all."""
_PANELS = {
    "success": "success: share gained",
    "error": "capped error: ratio",
    "cost": "cost in simulations: ratio",
}


def contents(frame: pd.DataFrame, alpha: float) -> list[Table]:
    """A table per comparison, within 80 columns; what the columns mean stands below the last."""
    titles = ("", "first", "second", "change", f"{100 * (1 - alpha):g} %", "p", "e", "second is")
    tables = []
    for title, rows in _comparisons(frame):
        cells = list(zip(*map(_cells, rows), strict=True))
        last = len(titles) - 1
        columns = [(words if i in (0, last) else texts)(t, cells[i]) for i, t in enumerate(titles)]
        tables.append(Table("comparison", title, "", columns))
    note = (
        "error: mean Mahalanobis error, each trial's at most the radius of the gate of success. cost: simulations."
        " p: McNemar's exact test, random signs for ratios; Holm over all rows. e: evidence that may be looked at as"
        " often as one likes, 20 being as rare as p = 0.05. Intervals are each row's own. time: not tested."
    )
    if (frame["matched_by"] == "order").any():
        note += " Without common trials nothing is gained from pairing: the intervals are wider."
    return [*tables[:-1], *(replace(last, notes=[note]) for last in tables[-1:])]


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
    """Writes comparison.csv, comparison as PNG and PDF, and a page of all; returns the files."""
    with house_style():
        drawings, table = [draw(frame, alpha)], ("comparison.csv", frame)
        return write(output, "comparison", "Comparison", contents(frame, alpha), table=table, drawings=drawings)


def draw(frame: pd.DataFrame, alpha: float) -> Drawing:
    """Draws a line per comparison and a panel per quantity, with intervals, coloured if significant."""
    from matplotlib.lines import Line2D

    found = [rows for _, rows in _comparisons(frame)][:MOST_ROWS]
    labels = [_row_label(rows[0], frame) for rows in found]
    longest = max(len(label) for label in labels)
    fig = common.figure(7.4 + min(0.065 * longest, 3.2), 1.3 + 0.28 * len(found))
    axes = list(fig.subplots(1, len(_PANELS), sharey=True))
    for (quantity, title), ax in zip(_PANELS.items(), axes, strict=True):
        _panel(ax, [row for rows in found for row in rows if row["quantity"] == quantity], quantity)
        ax.set_title(title)
    axes[0].set_yticks(range(len(labels)), [common.text(label) for label in labels])
    axes[0].set_ylim(len(labels) - 0.4, -0.6)
    handles = [
        Line2D([], [], color=color, marker="o", markersize=5, label=f"second is {name}" if name else "not sure")
        for name, color in _COLORS.items()
    ]
    fig.legend(handles=handles, loc="outside upper center", ncols=3)
    level = f"{100 * (1 - alpha):g} %"
    caption = f"The second less, or over, the first, with intervals of {level}; coloured where sure."
    return Drawing("comparison", "Comparison", caption, fig)


def _panel(ax: Any, rows: Sequence[dict[str, Any]], quantity: str) -> None:
    from matplotlib.ticker import MaxNLocator

    none = 0.0 if quantity == "success" else 1.0
    for i, row in enumerate(rows):
        color = _COLORS[row["finding"]]
        ax.plot([row["low"], row["high"]], [i, i], color=color, linewidth=1.6, solid_capstyle="butt")
        ax.plot([row["change"]], [i], color=color, marker="o", markersize=5, linestyle="")
    ax.axvline(none, color=BOUND_COLOR, linewidth=0.8, zorder=0)
    ends = np.array([[row["low"], row["high"], row["change"], none] for row in rows], dtype=float)
    ends = ends[np.isfinite(ends)]
    if quantity == "success":
        reach = max(0.01, 1.1 * float(np.abs(ends).max()))
        ax.set_xlim(-reach, reach)
        ax.xaxis.set_major_locator(MaxNLocator(5, symmetric=True))
        ax.xaxis.set_major_formatter(lambda v, _: f"{100 * v:+.3g} %".replace("-", "\N{MINUS SIGN}") if v else "0")
        return
    reach = max(1.05, float(np.maximum(ends[ends > 0], 1 / ends[ends > 0]).max()) ** 1.1)
    ax.set(xscale="log", xlim=(1 / reach, reach))
    if reach >= 2:
        common.log_ticks(ax.xaxis, 1 / reach, reach)
    else:
        step = float(f"{(reach - 1) / 1.5:.0e}")
        ax.set_xticks([1 - step, 1, 1 + step], [f"{1 - step:g}", "1", f"{1 + step:g}"])
        ax.set_xticks([], minor=True)


def _row_label(row: dict[str, Any], frame: pd.DataFrame) -> str:
    """What tells this comparison from the others."""
    settings = [c for c in frame.columns if c not in NOT_SETTINGS]
    varying = [c for c in settings if len(set(frame[c].astype(str))) > 1] or ["error_scale"]
    who = row["first"] if row["first"] == row["second"] else f"{row['first']}, {row['second']}"
    return ", ".join([who, *(f"{c.replace('_', ' ')} {plain(row[c])}" for c in varying if c in row)])
