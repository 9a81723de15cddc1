"""Draws the changes of a comparison."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ipe_bench.questions.compare.maths import comparison_title, kind_of
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, FAMILIES, WHITE, Look, strong
from ipe_bench.report.words import compact, told_apart

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


MOST_ROWS = 30
"""Comparisons in a figure; its table has all."""
_TIMES = 2.0
"""Ratios above are said as multiples."""
_COLORS = {"better": FAMILIES["least squares"][0], "worse": FAMILIES["filters"][0]}


class _Measure(NamedTuple):
    """Describes the axis of a quantity's changes."""

    words: str
    unit: str
    margin: str
    """The largest change that does not matter, in words."""
    factor: int
    """What changes are multiplied by."""
    same: float
    """No change."""
    least: float
    most: float
    """The ends of the changes that do not matter."""

    @property
    def ratio(self) -> bool:
        return self.same == 1.0


def _measure(kind: str, margin: float) -> _Measure:
    if kind.startswith("bias"):
        return _Measure("difference", "", f"{margin:g}", 1, 0.0, -margin, margin)
    share = 100 * margin
    if kind == "success":
        return _Measure("points", " points", f"{share:g} points", 100, 0.0, -share, share)
    return _Measure("ratio", " %", f"{share:g} %", 1, 1.0, 1 / (1 + margin), 1 + margin)


def draw_pairs(frame: pd.DataFrame) -> Iterator[Drawing]:
    """Draws the change of each tested quantity with its interval, a row per comparison, and says
    what it is worth."""
    listed: list[Any] = frame.to_dict("records")
    rows = [row for row in listed if np.isfinite(row["low"]) and np.isfinite(row["high"])]
    if not rows:
        return
    names = _names(rows)
    labels = list(dict.fromkeys(names))
    kinds = list(dict.fromkeys(row["quantity"] for row in rows))[: common.most_panels()]
    look = dict.fromkeys(labels[:MOST_ROWS], Look(BOUND_COLOR, "o"))
    fig, axes = common.panels(len(kinds), look, scales=[0.0], row=1)
    fig.set_figheight((0.4 * len(look) + 0.75) * len(kinds) + 0.3)
    told = []
    for kind, ax in zip(kinds, axes, strict=True):
        measure = _measure(kind, frame.attrs["margins"][kind_of(kind)])
        named = [(row, name) for row, name in zip(rows, names, strict=True) if name in look]
        shown = [(row, labels.index(name)) for row, name in named if row["quantity"] == kind]
        for row, y in shown:
            _draw_change(ax, row, y, measure)
        _set_axis(ax, measure)
        for row, y in shown:
            _mark_cut(ax, row, y, measure)
        told.append(f"{kind}, {measure.words}")
    common.titles(axes, told)
    common.legend(fig, axes)
    caption = (
        "Second against first in the same trials, each with its own interval. Filled: beyond the"
        " margin."
    )
    if len(labels) > MOST_ROWS:
        caption += f" {len(labels) - MOST_ROWS} further comparisons are in the table."
    yield Drawing("comparison", "Changes trial by trial", caption, fig)


def _names(rows: Sequence[Any]) -> list[str]:
    """Names each row by what not all of them share, and by the second's name if all are alike."""
    parts = [(row["second"], *comparison_title(row).split(", ")) for row in rows]
    if len(set(parts)) == 1:
        return [row["second"] for row in rows]
    shared = set.intersection(*map(set, parts))
    return [", ".join(word for word in words if word not in shared) for words in parts]


def _draw_change(ax: Axes, row: Any, y: int, measure: _Measure) -> None:
    """Draws a change with its interval at its place down the axis, and words beside it."""
    low = measure.factor * row["low"]
    high = measure.factor * row["high"]
    color = _COLORS.get(row["finding"], BOUND_COLOR)
    ax.plot([low, high], [y, y], color=color, linewidth=1.8)
    face = color if row["finding"] else "white"
    point: Any = {"color": color, "markerfacecolor": face, "markeredgecolor": color}
    ax.plot(measure.factor * row["change"], y, "o", **point)
    style: Any = {"color": strong(color), "annotation_clip": False, "va": "bottom"}
    style["bbox"] = {"facecolor": WHITE, "edgecolor": "none", "pad": 1.0}
    place: Any = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    ax.annotate(_outcome(row, low, high, measure), (0, y), xytext=(3, 5), **place, **style)


def _set_axis(ax: Axes, measure: _Measure) -> None:
    """Sets an axis that shows no change and the band of those below the margin."""
    low, high = ax.get_xlim()
    if measure.ratio and high > 3 * max(low, 0.0):
        ax.set_xscale("log")
        low, high = ax.get_xlim()
        low = min(low, 0.8)
        high = max(high, 1.25)
        common.log_ticks(ax.xaxis, low, high)
    elif measure.ratio:
        low = min(low, 0.9)
        high = max(high, 1.1)
    ax.set_xlim(min(low, measure.least), max(high, measure.most))
    common.band(ax, measure.least, measure.most, "smaller than the margin")
    ax.axvline(measure.same, color=BOUND_COLOR, linewidth=0.8, linestyle=":")


def _mark_cut(ax: Axes, row: Any, y: int, measure: _Measure) -> None:
    """Marks an interval that ends beyond the axis by an arrow at its edge."""
    low, high = ax.get_xlim()
    color = _COLORS.get(row["finding"], BOUND_COLOR)
    if measure.factor * row["low"] < low:
        common.mark_cut(ax, [y], low, color, downwards=True)
    if measure.factor * row["high"] > high:
        common.mark_cut(ax, [y], high, color, downwards=False)


def _outcome(row: Any, low: float, high: float, measure: _Measure) -> str:
    """Words whether an interval lies within the margin, as in a test of equivalence, and else how
    much better or worse the second is."""
    if measure.least <= low and high <= measure.most:
        return f"the same within ± {measure.margin}"
    extent = _extent(low, high, measure)
    if row["finding"]:
        return f"{row['finding']}: {extent}"
    return f"significant, possibly negligible: {extent}" if row["different"] else "undecided"


def _extent(low: float, high: float, measure: _Measure) -> str:
    """Words the ends of an interval, by figures that tell them apart."""
    if measure.ratio and high > _TIMES:
        return f"{' to '.join(told_apart(low, high, compact))} times"
    if measure.ratio:
        ends = told_apart(100 * (low - 1), 100 * (high - 1), _signed)
    else:
        ends = told_apart(low, high, _signed)
    return f"{' to '.join(ends)}{measure.unit}"


def _signed(value: float, more: int) -> str:
    """Formats two figures and so many `more`, and whole numbers whole."""
    if abs(value) >= 10:
        return f"{value:+.{more}f}"
    return f"{value:+.{2 + more}g}"
