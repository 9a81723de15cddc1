"""What figures share: panels, axes, curves that stay apart, legends and the words of captions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, Look
from ipe_bench.report.words import enumerate_few as enumerate_few
from ipe_bench.report.words import plain
from ipe_bench.trials.thresholds import FEW

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.path import Path

MOST_PANELS = 6
COINCIDE = 0.015
"""Points nearer than this part of the axis lie upon each other."""
NARROWEST, ROOMY = 1.7, 2.2
"""Inches of a panel in print: where there are many, and where there are few."""
PRINTED_MARK = 0.62
"""Size of a marker in print, beside that on the page."""
REACH = 0.3
"""Part of the span of the points that intervals may add to an axis at either end."""
LETTER, PRINTED_LETTER = 0.08, 0.068
"""Inches of a letter under an axis, with the space around it: on the page, and in print."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
UPON = "Where points coincide, each marker lies smaller upon the one before it."


def text(value: Any) -> str:
    """A name as it stands in a figure: never read as mathematics, never longer than a line."""
    words = str(value)
    words = words if len(words) <= 42 else words[:40] + "…"
    words = words.replace("\\", "\\\\").replace("$", r"\$")
    # A leading underscore would hide the name from legends.
    return "\u200b" + words if words.startswith("_") else words


_column: ContextVar[float | None] = ContextVar("column", default=None)


@contextmanager
def column_width(inches: float) -> Iterator[None]:
    """Figures that are drawn meanwhile are as wide as a column of print, and no panel narrower than `NARROWEST`."""
    token = _column.set(inches)
    try:
        yield
    finally:
        _column.reset(token)


def figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    column = _column.get()
    if column is None or width == column:
        size = width, height
    else:
        size = column, max(1.8, height * column / width)
    return Figure(figsize=size, layout="constrained")


def mark_scale() -> float:
    """What sizes of markers are multiplied by."""
    return 1.0 if _column.get() is None else PRINTED_MARK


def panels(
    count: int, look: Mapping[str, Look] | None = None, *, height: float = 2.7, most_across: int | None = None
) -> tuple[Figure, list[Axes]]:
    """A figure with that many panels, unused ones switched off, and room for the legend of the estimators."""
    across = most_across or {4: 2, 7: 4, 8: 4}.get(count, 3)
    column = _column.get()
    if column is not None:
        return _narrow_panels(count, min(across, count), column)
    across = min(across, count)
    down = -(-count // across)
    width = {1: 5.2, 2: 8.0, 3: 9.2}.get(across, 11.0)
    fig = figure(width, height * down + 0.4 + 0.2 * len(look or ()) / 5)
    axes: list[Axes] = list(fig.subplots(down, across, squeeze=False).flat)
    for ax in axes[count:]:
        ax.set_axis_off()
    return fig, axes[:count]


def _narrow_panels(count: int, across: int, column: float) -> tuple[Figure, list[Axes]]:
    """Panels in a column of print; their legend adds its own height."""
    across = max(1, min(across, int(column / (NARROWEST if count > 3 else ROOMY))))
    down = -(-count // across)
    fig = figure(column, max(1.75, 0.75 * column / across) * down)
    axes: list[Axes] = list(fig.subplots(down, across, squeeze=False).flat)
    for ax in axes[count:]:
        ax.set_axis_off()
    return fig, axes[:count]


def spread(values: Sequence[Any], most: int = MOST_PANELS) -> list[Any]:
    """At most that many of the values, evenly spread and with both ends."""
    if len(values) <= most:
        return list(values)
    return [values[i] for i in np.unique(np.linspace(0, len(values) - 1, most).round().astype(int))]


def at_scale(frame: pd.DataFrame, scale: float) -> pd.DataFrame:
    return frame[frame["error_scale"] == scale]


def scale_axis(ax: Axes, scales: Sequence[float], labels: Sequence[str]) -> None:
    """A logarithmic axis that shows the error scales themselves; where there is one alone, the labels side by side."""
    if len(scales) == 1:
        ax.set_xticks(range(len(labels)), [text(label) for label in labels], rotation=90)
        ax.set_xlim(-0.6, len(labels) - 0.4)
        ax.set_xlabel("")
        return
    positive = sorted(s for s in scales if s > 0)
    # A scale of zero has no place on a logarithmic axis: a decade below the smallest is as near as it gets.
    least = positive[0] / 10 if len(positive) < len(scales) else positive[0]
    ax.set_xscale("symlog", linthresh=positive[0], linscale=0.5) if least < positive[0] else ax.set_xscale("log")
    span = np.log10(positive[-1] / least)
    kept = [0.0] * (least < positive[0]) + _labelled(positive, span / (ax.get_position().width * _width(ax)))
    ax.set_xticks(kept, [plain(s) for s in kept])
    ax.set_xticks([], minor=True)
    margin = 10 ** max(0.06 * span, 0.15)
    ax.set_xlim(-0.3 * positive[0] if least < positive[0] else least / margin, positive[-1] * margin)
    ax.set_xlabel("error scale")


def _labelled(scales: Sequence[float], decades_an_inch: float) -> list[float]:
    """Those of ascending scales whose labels have room: both ends, and what fits between them."""
    letter = decades_an_inch * (LETTER if _column.get() is None else PRINTED_LETTER)

    def apart(a: float, b: float) -> bool:
        return np.log10(b / a) > letter * (len(plain(a)) + len(plain(b)) + 1) / 2

    kept = [scales[0]]
    for scale in scales[1:-1]:
        if apart(kept[-1], scale) and apart(scale, scales[-1]):
            kept.append(scale)
    return [*kept, scales[-1]] if len(scales) > 1 else kept


def _width(ax: Axes) -> float:
    return ax.figure.get_figwidth()  # type: ignore[union-attr]


def decades(ax: Axes, values: Any, least: float = 10.0, *, ends: Any = ()) -> None:
    """A logarithmic axis around the values that spans at least a decade, so that scatter of a per cent looks small.

    The `ends` of intervals widen it by no more than `REACH` of the values' own span, or a decade: those of heavy tails,
    which may be as wide as numbers go, end at the panel's edge.
    """
    values, ends = (_positive(v) for v in (values, ends))
    if len(values) == 0:
        # A logarithmic axis without anything to show makes matplotlib warn.
        return
    ax.set_yscale("log")
    low, high = float(values.min()), float(values.max())
    room = max(least, (high / low) ** REACH)
    low = max(low / room, ends.min(initial=low)) / 1.6
    high = min(high * room, ends.max(initial=high)) * 1.6
    if high / low < least:
        middle = np.sqrt(low * high)
        low, high = middle / np.sqrt(least), middle * np.sqrt(least)
    ax.set_ylim(low, high)
    log_ticks(ax.yaxis, low, high)


def _positive(values: Any) -> Any:
    values = np.asarray(values, dtype=float).ravel()
    return values[np.isfinite(values) & (values > 0)]


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Labels that do not crowd: powers of ten, and 2 and 5 between where those are few."""
    from matplotlib.ticker import LogLocator, NullLocator

    if high / low < 200:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
    else:
        axis.set_major_locator(LogLocator(numticks=7))
        axis.set_major_formatter(lambda value, _: power_of_ten(value))
    axis.set_minor_locator(NullLocator())


def power_of_ten(value: float) -> str:
    """10⁻³ in plain letters, which are set and measured in a fraction of the time that mathematics takes."""
    return "10" + f"{round(np.log10(value))}".translate(_RAISED)


def shares(ax: Axes, label: str) -> None:
    """A vertical axis from none to all."""
    ax.set_ylim(-0.03, 1.03)
    ax.yaxis.set_major_formatter(lambda v, _: f"{100 * v:.0f} %")
    ax.set_ylabel(label)


def seaborn_style(look: Mapping[str, Look], by: str = "estimator") -> dict[str, Any]:
    """Arguments of seaborn's functions that give every label its own colour and dash."""
    return {
        "hue": by,
        "hue_order": list(look),
        "palette": {label: one.color for label, one in look.items()},
        "style": by,
        "style_order": list(look),
        "legend": False,
    }


def curves(
    ax: Axes,
    rows: pd.DataFrame,
    y: str,
    look: Mapping[str, Look],
    scales: Sequence[float],
    *,
    interval: tuple[str, str] | None = None,
    by: str = "estimator",
    trials: str = "solved_trials",
) -> None:
    """A column over the error scales, a line with markers per label, on an axis whose limits are set already.

    Points stand at their scale exactly: markers that coincide are told apart by size. A line is broken where a value is
    missing; a point that fewer than `FEW` trials carry is hollow and has no interval.
    """
    scale_axis(ax, scales, list(look))
    place = {label: i for i, label in enumerate(look)}
    rows = rows[rows[by].isin(list(look))].sort_values("error_scale", kind="stable")
    rows = rows.assign(x=rows["error_scale"] if len(scales) > 1 else rows[by].map(place).astype(float))
    rows = rows.assign(run=rows.groupby(by)[y].transform(lambda values: values.isna().cumsum()))
    rows = rows[np.isfinite(rows[y])]
    if rows.empty:
        return
    depths = _depths(ax, rows, y, look, by)
    if len(scales) > 1:
        for (label, _), part in rows.groupby([by, "run"], sort=False):
            one = look[str(label)]
            ax.plot(part["x"], part[y], color=one.color, linestyle=one.linestyle, linewidth=1.4)
    few = (rows[trials] < FEW).to_numpy()
    if interval is not None:
        low, high = interval
        sure = rows[~few & np.isfinite(rows[low]) & np.isfinite(rows[high])]
        ax.vlines(sure["x"], sure[low], sure[high], colors=[look[e].color for e in sure[by]], linewidth=1.0, alpha=0.8)
    sizes = (mark_scale() * (5.5 + min(2.5, 9 / len(look)) * depths)) ** 2
    for which in (~few, few):
        if which.any():
            part = rows[which]
            marks(ax, part["x"], part[y], [look[label] for label in part[by]], sizes[which], hollow=which is few)
    if few.any():
        _explain_hollow(ax)
    ax.set(xlabel="error scale" if len(scales) > 1 else "", ylabel="")


def marks(
    ax: Axes, x: Any, y: Any, looks: Sequence[Look], sizes: Any, *, hollow: bool = False, linewidth: float = 0.6
) -> None:
    """A marker per point in the look of its own, all of them one artist."""
    colors = [one.color for one in looks]
    points = ax.scatter(x, y, s=sizes, c=colors, edgecolors="white", linewidths=linewidth, zorder=3)
    points.set_paths([_marker_path(one.marker) for one in looks])
    if hollow:
        points.set(edgecolor=colors, facecolor="white", linewidth=1.2)


@cache
def _marker_path(marker: str) -> Path:
    from matplotlib.markers import MarkerStyle

    shape = MarkerStyle(marker)
    return shape.get_path().transformed(shape.get_transform())


def _explain_hollow(ax: Axes) -> None:
    """Says in the legend what an empty marker means."""
    from matplotlib.lines import Line2D

    look = {"marker": "o", "color": "white", "markeredgecolor": BOUND_COLOR, "markersize": 6}
    ax.add_line(Line2D([], [], label=f"hollow: fewer than {FEW} trials", **look))


def _depths(ax: Axes, rows: pd.DataFrame, y: str, look: Mapping[str, Look], by: str) -> Any:
    """How many later markers lie upon each point's."""
    transform = ax.yaxis.get_transform().transform
    low, high = transform(np.asarray(ax.get_ylim()))
    heights = (transform(rows[y].to_numpy(dtype=float)) - low) / (high - low)
    places = rows["x"].to_numpy()
    order = rows[by].map({label: i for i, label in enumerate(look)}).to_numpy()
    upon = (places[:, None] == places) & (np.abs(heights[:, None] - heights) < COINCIDE)
    return (upon & (order[:, None] < order)).sum(axis=1)


def lines(
    ax: Axes,
    rows: pd.DataFrame,
    x: str,
    y: str,
    look: Mapping[str, Look],
    *,
    every: int = 1,
    sort: bool = True,
    **style: Any,
) -> None:
    """A line per estimator through points that are already dense, with a marker at every so many: each estimator's at
    other ones, so that markers stand side by side where curves coincide."""
    rows = rows[np.isfinite(rows[x]) & np.isfinite(rows[y])]
    parts = {str(label): part for label, part in rows.groupby("estimator", sort=False)}
    present = [label for label in look if label in parts]
    for i, label in enumerate(present):
        one = look[label]
        part = parts[label].sort_values([x, y]) if sort else parts[label]
        ax.plot(
            part[x],
            part[y],
            **{"color": one.color, "linestyle": one.linestyle, "linewidth": 1.4, "marker": one.marker} | style,
            markersize=5 * mark_scale(),
            markevery=(every * i // len(present), every),
            markeredgecolor="white",
            markeredgewidth=0.5,
        )


def bound_line(ax: Axes, at: float, label: str) -> None:
    ax.axhline(at, color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0, label=label, zorder=1)


def legend_below(fig: Figure, axes: Sequence[Axes], look: Mapping[str, Look] | None = None) -> None:
    """One legend for all panels, under them: the estimators, then whatever in the panels has a label."""
    from matplotlib.lines import Line2D

    handles: dict[str, Any] = {text(label): Line2D([], [], **one.line) for label, one in (look or {}).items()}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if not handles:
        return
    columns, printed = _legend_columns(list(handles), fig.get_figwidth()), _column.get() is not None
    if printed:
        fig.set_figheight(fig.get_figheight() + 0.15 * -(-len(handles) // columns) + 0.1)
    fig.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=columns)


def _legend_columns(labels: Sequence[str], width: float) -> int:
    """As many as fit side by side, each as wide as its longest label."""
    handle, letter = (0.55, 0.075) if _column.get() is None else (0.38, 0.06)

    def needed(columns: int) -> float:
        parts = np.array_split(np.array([len(label) for label in labels]), columns)
        return sum(handle + letter * float(part.max()) for part in parts)

    return next((n for n in range(len(labels), 1, -1) if needed(n) <= width), 1)


def values_of(rows: pd.DataFrame, column: str, *, most: int = 20) -> str:
    """'a 1.02, b 3.4': a column by estimator, in three figures."""
    pairs = zip(rows["estimator"], rows[column], strict=True)
    return enumerate_few([f"{e} {v:.3g}" for e, v in pairs if np.isfinite(v)], most)


def sentence(*parts: str) -> str:
    """The parts of a caption that say something, one after another."""
    return " ".join(part for part in parts if part)
