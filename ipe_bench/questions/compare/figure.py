"""Draws the changes of a comparison."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.questions.compare.maths import comparison_title
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, FAMILIES, Look, print_width
from ipe_bench.report.words import compact

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


MOST_ROWS = 30
"""Comparisons in a figure; its table has all."""
_TIMES = 2.0
"""Ratios above are said as multiples."""
_COLORS = {"better": FAMILIES["least squares"][0], "worse": FAMILIES["filters"][0]}


def draw_pairs(frame: pd.DataFrame) -> Iterator[Drawing]:
    """Draws the change of each tested quantity with its interval, a row per comparison, and says what it is worth."""
    listed: list[Any] = frame.to_dict("records")
    rows = [row for row in listed if np.isfinite(row["low"]) and np.isfinite(row["high"])]
    if not rows:
        return
    parts = [[row["second"], *comparison_title(row).split(", ")] for row in rows]
    shared = set.intersection(*map(set, parts)) if len(set(map(tuple, parts))) > 1 else set()
    names = {
        id(row): ", ".join(w for w in words if w not in shared)
        for row, words in zip(rows, parts, strict=True)
    }
    labels = list(dict.fromkeys(names.values()))
    kinds = list(dict.fromkeys(row["quantity"] for row in rows))[: common.most_panels()]
    look = dict.fromkeys(labels[:MOST_ROWS], Look(BOUND_COLOR, "o"))
    fig, axes = common.panels(len(kinds), look, scales=[0.0], row=2)
    fig.set_figwidth(print_width() or 10.4)
    for kind, ax in zip(kinds, axes, strict=True):
        shown = [row for row in rows if row["quantity"] == kind and names[id(row)] in look]
        places = [labels.index(names[id(row)]) for row in shown]
        _draw_changes(ax, kind, shown, places, frame.attrs["margins"][kind.partition(" ")[0]])
    common.legend(fig, axes)
    caption = "Second against first in the same trials, each with its own interval. Filled: beyond the margin."
    if len(labels) > MOST_ROWS:
        caption += f" {len(labels) - MOST_ROWS} further comparisons are in the table."
    yield Drawing("comparison", "Changes trial by trial", caption, fig)


def _draw_changes(
    ax: Axes, kind: str, rows: Sequence[Any], places: Sequence[int], margin: float
) -> None:
    """Draws the changes of one quantity at their places down the axis, beside the band of those below the margin."""
    ratio = kind != "success" and not kind.startswith("bias")
    factor = 100 if kind == "success" else 1
    same, least, most = (
        (1.0, 1 / (1 + margin), 1 + margin) if ratio else (0.0, -factor * margin, factor * margin)
    )
    for row, y in zip(rows, places, strict=True):
        low, at, high = (factor * row[name] for name in ("low", "change", "high"))
        color = _COLORS.get(row["finding"], BOUND_COLOR)
        ax.plot([low, high], [y, y], color=color, linewidth=1.8)
        face = color if row["finding"] else "white"
        ax.plot(at, y, "o", color=color, markerfacecolor=face, markeredgecolor=color)
        unit = "" if kind.startswith("bias") else " %" if ratio else " points"
        within = f"the same within ± {100 * margin if unit else margin:g}{unit}"
        words = within if least <= low and high <= most else _outcome(row, low, high, unit)
        style: Any = {"va": "center", "fontsize": "small", "annotation_clip": False}
        place: Any = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        ax.annotate(words, (1, y), xytext=(6, 0), **place, **style)
    low, high = ax.get_xlim()
    if ratio and high > 3 * max(low, 0.0):
        ax.set_xscale("log")
        low, high = ax.get_xlim()
        low, high = min(low, 0.8), max(high, 1.25)
        common.log_ticks(ax.xaxis, low, high)
    elif ratio:
        low, high = min(low, 0.9), max(high, 1.1)
    ax.set_xlim(min(low, least), max(high, most))
    common.band(ax, least, most, "smaller than the margin")
    ax.axvline(same, color=BOUND_COLOR, linewidth=0.8, linestyle=":")
    common.title(
        ax, f"{kind}, {'ratio' if ratio else 'points' if kind == 'success' else 'difference'}"
    )


def _outcome(row: Any, low: float, high: float, unit: str) -> str:
    """Words what an interval that reaches beyond the margin says of the second: how much it is better or worse."""
    extent = f"{low:+.2g} to {high:+.2g}{unit}"
    if unit == " %" and high > _TIMES:
        extent = f"{compact(low)} to {compact(high)} times"
    elif unit == " %":
        extent = f"{100 * (low - 1):+.2g} to {100 * (high - 1):+.2g} %"
    if row["finding"]:
        return f"{row['finding']}: {extent}"
    return f"perhaps within the margin: {extent}" if row["different"] else "undecided"
