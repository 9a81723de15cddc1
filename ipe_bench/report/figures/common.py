"""What figures share: panels, axes, curves with their intervals, legends and the words of captions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, GREY, MOST_FACES, Look
from ipe_bench.report.words import enumerate_few as enumerate_few
from ipe_bench.report.words import plain
from ipe_bench.trials.thresholds import FEW

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

REACH = 0.3
"""Part of the span of the points that intervals may add to an axis at either end."""
LETTER, PRINTED_LETTER = 0.08, 0.062
"""Inches of a letter under an axis, with the space around it: on the page, and in print."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


_column: ContextVar[float | None] = ContextVar("column", default=None)


def text(value: Any) -> str:
    """A name as it stands in a figure: never read as mathematics, never longer than a line."""
    words, most = str(value), 42 if _column.get() is None else 16
    words = words if len(words) <= most else words[: most - 1] + "…"
    words = words.replace("\\", "\\\\").replace("$", r"\$")
    # A leading underscore would hide the name from legends.
    return "\u200b" + words if words.startswith("_") else words


@contextmanager
def column_width(inches: float) -> Iterator[None]:
    """Figures that are drawn meanwhile are as wide as a column of print."""
    token = _column.set(inches)
    try:
        yield
    finally:
        _column.reset(token)


def figure(width: float, height: float) -> Figure:
    """An empty figure; in print as wide as the column, in the same shape."""
    from matplotlib.figure import Figure

    column = _column.get()
    size = (width, height) if column is None else (column, max(1.9, height * column / width))
    return Figure(figsize=size, layout="constrained")


def most_panels() -> int:
    """Panels of a figure: six on the page, two rows in a column of print."""
    column = _column.get()
    return 6 if column is None or column > 5 else 4


def panels(
    count: int, look: Mapping[str, Look] | None = None, *, height: float = 2.7, most_across: int | None = None
) -> tuple[Figure, list[Axes]]:
    """A figure with that many panels, in print in at most two rows, and room for the legend of the estimators."""
    column = _column.get()
    if column is None:
        across = min(count, most_across or {4: 2, 7: 4, 8: 4}.get(count, 3))
        down = -(-count // across)
        width = {1: 5.2, 2: 8.0, 3: 9.2}.get(across, 11.0)
        size = width, height * down + 0.4 + 0.2 * len(look or ()) / 5
    else:
        across = min(count, max(2, -(-count // 2)) if column < 5 or count == 4 else 3)
        down = -(-count // across)
        size = column, max(1.5, 0.85 * column / across) * down + 0.16 * len(look or ()) / 3 + 0.2
    from matplotlib.figure import Figure

    fig = Figure(figsize=size, layout="constrained")
    axes: list[Axes] = list(fig.subplots(down, across, squeeze=False).flat)
    for ax in axes[count:]:
        ax.set_axis_off()
    return fig, axes[:count]


def title(ax: Axes, words: str) -> None:
    """Sets the title of a panel, in as many lines as its width needs."""
    letters = max(12, int(_inches(ax) / (0.078 if _column.get() is None else 0.056)))
    broken = max(map(len, words.split()), default=0) > 20
    ax.set_title(fill(words.replace("$", r"\$"), letters, break_long_words=broken))


def _inches(ax: Axes) -> float:
    """About the width of a panel: in print its labels take a fourth of what the layout has not given them yet."""
    width = ax.get_position().width * ax.figure.get_figwidth()  # type: ignore[union-attr]
    return width if _column.get() is None else min(0.75 * width, width - 0.45)


def axis_labels(fig: Figure, x: str, y: str) -> None:
    """Labels of the axes that all panels share, once for the figure."""
    fig.supxlabel(x, fontsize="medium")
    fig.supylabel(y, fontsize="medium")
    for ax in fig.axes:
        ax.set(xlabel="", ylabel="")


def spread(values: Sequence[Any], most: int | None = None) -> list[Any]:
    """At most that many of the values, evenly spread and with both ends."""
    most = most or most_panels()
    if len(values) <= most:
        return list(values)
    return [values[i] for i in np.unique(np.linspace(0, len(values) - 1, most).round().astype(int))]


def at_scale(frame: pd.DataFrame, scale: float) -> pd.DataFrame:
    return frame[frame["error_scale"] == scale]


def scale_axis(ax: Axes, scales: Sequence[float], labels: Sequence[str]) -> None:
    """A logarithmic axis that shows the error scales themselves; if there is one alone, the labels side by side."""
    if len(scales) == 1:
        ax.set_xticks(range(len(labels)), [text(label) for label in labels], rotation=90)
        ax.set_xlim(-0.6, len(labels) - 0.4)
        return
    positive = sorted(s for s in scales if s > 0)
    # A scale of zero has no place on a logarithmic axis: a decade below the smallest is as near as it gets.
    least = positive[0] / 10 if len(positive) < len(scales) else positive[0]
    ax.set_xscale("symlog", linthresh=positive[0], linscale=0.5) if least < positive[0] else ax.set_xscale("log")
    span = np.log10(positive[-1] / least)
    # Names at the ends of lines take their room, too.
    inches = _inches(ax) - (0.8 if len(labels) > MOST_FACES else 0.0)
    kept = [0.0] * (least < positive[0]) + _labelled(positive, span / max(inches, 0.3))
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
    """Labels that do not crowd: powers of ten, and 2 and 5 between if those are few."""
    from matplotlib.ticker import LogLocator, NullLocator

    if high / low < 200:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
    else:
        axis.set_major_locator(LogLocator(numticks=7))
        axis.set_major_formatter(lambda value, _: power_of_ten(value))
    axis.set_minor_locator(NullLocator())


def power_of_ten(value: float) -> str:
    """10⁻³ in plain letters, which take a fraction of the time that mathematics does."""
    return "10" + f"{round(np.log10(value))}".translate(_RAISED)


def shares(ax: Axes, label: str) -> None:
    """A vertical axis from none to all."""
    ax.set_ylim(-0.03, 1.03)
    ax.yaxis.set_major_formatter(lambda v, _: f"{100 * v:.0f} %")
    ax.set_ylabel(label)


def seaborn_style(look: Mapping[str, Look], by: str = "estimator") -> dict[str, Any]:
    """Arguments of seaborn's functions that give every label its own colour, marker and dash; grey ones lie below."""
    order = sorted(look, key=lambda label: look[label].color != GREY)
    return {
        "hue": by,
        "hue_order": order,
        "palette": {label: one.color for label, one in look.items()},
        "style": by,
        "style_order": order,
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
    trials: str = "trials",
) -> None:
    """A column over the error scales, a line with markers per label, on an axis whose limits are set already.

    Labels stand side by side about their scale, so that points and intervals that coincide are seen. A line is broken
    where a value is missing; a point that some of the trials or fewer than `FEW` carry is hollow, and without an
    interval if they are fewer than `FEW`.
    """
    import seaborn as sns

    scale_axis(ax, scales, list(look))
    rows = rows[rows[by].isin(list(look))].sort_values("error_scale", kind="stable")
    rows = rows.assign(x=_places(rows, by, list(look), scales))
    rows = rows.assign(run=rows.groupby(by)[y].transform(lambda values: values.isna().cumsum()))
    rows = rows[np.isfinite(rows[y])]
    if not rows.empty:
        style = seaborn_style(look, by) | {
            "markers": {label: one.marker for label, one in look.items()},
            "dashes": {label: one.dash for label, one in look.items()},
        }
        size, thick = (5.0, 1.4) if _column.get() is None else (3.4, 1.0)
        width = {"linewidth": thick if len(scales) > 1 else 0, "markersize": size, "markeredgewidth": 0.5}
        sns.lineplot(rows, x="x", y=y, units="run", estimator=None, ax=ax, **width, **style)
        few = rows[trials] < FEW
        if interval is not None:
            low, high = interval
            plain_grey = rows[by].map(lambda label: look[str(label)].color == GREY)
            sure = rows[~few & ~plain_grey & np.isfinite(rows[low]) & np.isfinite(rows[high])]
            colors = [look[e].color for e in sure[by]]
            ax.vlines(sure["x"], sure[low], sure[high], colors=colors, linewidth=1.0, alpha=0.8)
        _hollow(ax, rows[few | (rows[trials] < rows["trials"].max())], y, look, by, size)
        if by == "estimator" and len(look) > MOST_FACES and len(scales) > 1 and most_panels() > 4:
            direct_labels(ax, rows, y, look, by)
    ax.set(xlabel="error scale" if len(scales) > 1 else "", ylabel="")


def _places(rows: pd.DataFrame, by: str, labels: Sequence[str], scales: Sequence[float]) -> Any:
    """Where points stand along the axis: a little beside their scale, each label at the same side of all of them."""
    order = rows[by].map({label: i for i, label in enumerate(labels)}).to_numpy(dtype=float)
    if len(scales) == 1:
        return order
    positive = np.log10([s for s in sorted(scales) if s > 0])
    gap = float(np.diff(positive).min(initial=1.0))
    return rows["error_scale"] * 10 ** (0.3 * gap * ((order + 0.5) / len(labels) - 0.5))


def _hollow(ax: Axes, rows: pd.DataFrame, y: str, look: Mapping[str, Look], by: str, size: float) -> None:
    """Empties the markers of these points, and says in the legend what that means."""
    empty = {"linestyle": "none", "markerfacecolor": "white", "markersize": size, "markeredgewidth": 1.1, "zorder": 3}
    for label, part in rows.groupby(by, sort=False):
        one = look[str(label)]
        ax.plot(part["x"], part[y], marker=one.marker, markeredgecolor=one.color, **empty)
    if len(rows):
        ax.plot([], [], marker="o", markeredgecolor=BOUND_COLOR, label="hollow: trials missing, or few", **empty)


def direct_labels(ax: Axes, rows: pd.DataFrame, y: str, look: Mapping[str, Look], by: str) -> None:
    """Names at the right ends of the lines: those in colour each, grey ones together where they end together."""
    last = rows[rows["error_scale"] == rows["error_scale"].max()]
    transform = ax.yaxis.get_transform().transform
    low, high = transform(np.array(ax.get_ylim()))
    ends = (transform(last[y].to_numpy(dtype=float)) - low) / (high - low)
    groups: list[tuple[float, list[str], str]] = []
    for end, label in sorted(zip(ends, last[by], strict=True)):
        color = look[label].color
        if color == GREY and groups and groups[-1][2] == GREY and end - groups[-1][0] < 0.05:
            groups[-1][1].append(label)
        else:
            groups.append((float(end), [label], color))
    longest = 24 if _column.get() is None else 10
    gap = 0.11 / (ax.get_position().height * ax.figure.get_figheight())  # type: ignore[union-attr]
    at = np.array([end for end, *_ in groups])
    for i in range(1, len(at)):
        at[i] = max(at[i], at[i - 1] + gap)
    for i in reversed(range(len(at))):
        at[i] = min(at[i], 1.0 if i == len(at) - 1 else at[i + 1] - gap)
    for y_at, (_, labels, color) in zip(at, groups, strict=True):
        words = labels[0] if len(labels) == 1 else f"{labels[0]} and {len(labels) - 1} more"
        words = words if len(words) <= longest else words[: longest - 1] + "…"
        place = {"xycoords": "axes fraction", "va": "center", "fontsize": 6.5, "annotation_clip": False}
        ax.annotate(text(words), (1.01, y_at), color=color if color != GREY else "#808080", **place)


def lines(ax: Axes, rows: pd.DataFrame, x: str, y: str, look: Mapping[str, Look], **style: Any) -> None:
    """A line per estimator through points that are already dense."""
    import seaborn as sns

    rows = rows[np.isfinite(rows[x]) & np.isfinite(rows[y])]
    rows = rows[rows["estimator"].isin(list(look))]
    dashes = {label: one.dash for label, one in look.items()}
    sns.lineplot(rows, x=x, y=y, ax=ax, estimator=None, dashes=dashes, linewidth=1.4, **(seaborn_style(look) | style))


def bound_line(ax: Axes, at: float, label: str) -> None:
    ax.axhline(at, color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0, label=label, zorder=1)


def legend(fig: Figure, axes: Sequence[Axes], look: Mapping[str, Look] | None = None) -> None:
    """One legend for all panels, above them: the estimators in colour, then what in the panels has a label."""
    from matplotlib.lines import Line2D

    colored = {label: one for label, one in (look or {}).items() if one.color != GREY}
    handles: dict[str, Any] = {text(label): Line2D([], [], **one.line) for label, one in colored.items()}
    if len(colored) < len(look or ()):
        handles[f"{len(look or ()) - len(colored)} others"] = Line2D([], [], color=GREY, linewidth=1.4)
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        columns = _legend_columns(list(handles), fig.get_figwidth())
        fig.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=columns)


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
