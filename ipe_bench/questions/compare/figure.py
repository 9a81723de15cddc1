"""Draws the changes of a comparison."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.questions.compare.maths import comparison_title
from ipe_bench.questions.panels import labelled_rows
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, FAMILIES

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


MOST_ROWS = 30
"""Comparisons in a figure; its table has all."""
_GOOD, _BAD = FAMILIES["least squares"][0], FAMILIES["filters"][0]
_FINDINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "better": ("better", {"marker": "o", "color": _GOOD}),
    "worse": ("worse", {"marker": "o", "color": _BAD}),
    "different": (
        "different, perhaps by less than the margin",
        {"marker": "D", "color": BOUND_COLOR},
    ),
    "": ("no difference found", {"marker": "o", "color": BOUND_COLOR, "markerfacecolor": "white"}),
}
"""The words and the mark of each outcome of a test."""


def draw_pairs(frame: pd.DataFrame) -> Iterator[Drawing]:
    """Draws the change of each tested quantity with its interval, a row per comparison."""
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
    fig, axes = labelled_rows(labels[:MOST_ROWS], len(kinds))
    for kind, ax in zip(kinds, axes, strict=True):
        shown = [
            row for row in rows if row["quantity"] == kind and names[id(row)] in labels[:MOST_ROWS]
        ]
        places = [labels.index(names[id(row)]) for row in shown]
        _draw_changes(ax, kind, shown, places, frame.attrs["margins"][kind.partition(" ")[0]])
    for words, mark in _FINDINGS.values():
        axes[0].plot([], [], linestyle="none", label=words, **mark)
    common.legend(fig, axes)
    caption = "Second against first in the same trials, each with its own interval; grey: changes below the margin."
    if len(labels) > MOST_ROWS:
        caption += f" {len(labels) - MOST_ROWS} further comparisons are in the table."
    yield Drawing("comparison", "Changes trial by trial", caption, fig)


def _draw_changes(
    ax: Axes, kind: str, rows: Sequence[Any], places: Sequence[int], margin: float
) -> None:
    """Draws the changes of one quantity at their places down the axis, beside the band of those below the margin."""
    factor = 100 if kind == "success" else 1
    for row, y in zip(rows, places, strict=True):
        _, mark = _FINDINGS[row["finding"] or "different" * row["different"]]
        ax.plot(
            [factor * row["low"], factor * row["high"]], [y, y], color=mark["color"], linewidth=1.4
        )
        ax.plot(factor * row["change"], y, **mark)
    ratio = kind != "success" and not kind.startswith("bias")
    same, least, most = (
        (1.0, 1 / (1 + margin), 1 + margin) if ratio else (0.0, -factor * margin, factor * margin)
    )
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
