"""Provides what figures share: panels, axes, curves with their intervals, legends and the words of
captions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from ipe_bench.basics.linalg import Array
from ipe_bench.report.figures.svg import NAMED
from ipe_bench.report.style import (
    BOUND_COLOR,
    BOUND_DASH,
    GREY,
    SOFT,
    Look,
    ink,
    print_width,
    strong,
)
from ipe_bench.report.words import value_text
from ipe_bench.trials.thresholds import FEW

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

T = TypeVar("T")
MOST_PANELS = 8
REACH = 0.3
"""Part of the span of the points that intervals may add to an axis at either end."""
_SAME_END = 0.01
"""Differences of shares up to which curves end at one place."""
_MOST_LETTERS = 30
"""Length of a label that curves share."""
_TEXT = -1
"""The number of a name among the artists of its curve."""
_ALONE = 4.2
"""Inches of a figure of a single panel: its letters are read on a phone."""
_AROUND = 90.0
"""Points of a figure's height above and below a panel, about."""
BEYOND = "beyond the axis"
"""Label of the arrow at points that lie there."""
_HOLLOW = "hollow: trials missing, or few"
"""Label of points that not all trials carry."""
_EMPTY: dict[str, Any] = {
    "linestyle": "none",
    "markerfacecolor": "white",
    "markeredgewidth": 1.1,
}
"""Arguments of hollow markers."""
_OF_NUMBERS = ".0123456789"
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def panels(
    count: int,
    look: Mapping[str, Look] | None = None,
    *,
    height: float = 2.7,
    scales: Sequence[float] = (),
    row: int = MOST_PANELS,
) -> tuple[Figure, list[Axes]]:
    """Makes a figure with that many panels, at most `row` side by side, and room for the legend of
    the estimators; if there is one of `scales` their names stand on the vertical axes, and values
    on the horizontal ones."""
    from matplotlib.figure import Figure

    down = -(-count // min(row, _across()))
    across = -(-count // down)
    width = print_width() or (_ALONE if across == 1 else min(2.0 + 3.2 * across, 11.0))
    names = list(look or ())
    each = min(height, 0.85 * width / across)
    size = (width, each * down + 0.4 + 0.05 * len(names))
    fig = Figure(figsize=size, layout="constrained")
    axes: list[Axes] = list(fig.subplots(down, across, squeeze=False).flat)
    for ax in axes[count:]:
        ax.set_axis_off()
    if len(scales) == 1:
        fig.set_figheight((0.22 * len(names) + 0.9) * down + 0.3)
        for ax in axes[:count]:
            name_axis(ax, names)
    return fig, axes[:count]


def name_axis(ax: Axes, names: Sequence[str]) -> None:
    """Sets names down the vertical axis; values stand on the horizontal one."""
    short = texts(names)
    ax.set_yticks(range(len(names)), [short[name] for name in names])
    ax.set_ylim(len(names) - 0.4, -0.6)


def _limits(ax: Axes) -> tuple[float, float]:
    """Returns the ends of the axis of values; none are known before they are set."""
    across = _value(ax) == "x"
    if ax.get_autoscalex_on() if across else ax.get_autoscaley_on():
        return -np.inf, np.inf
    low, high = sorted(ax.get_xlim() if across else ax.get_ylim())
    return low, high


def _value(ax: Axes) -> str:
    """Says on which axis values stand: the horizontal one where names stand downwards."""
    return "x" if ax.yaxis_inverted() else "y"


def _across() -> int:
    """Returns the largest number of panels side by side."""
    return max(2, int(print_width() / 1.7)) if print_width() else 4


def most_panels() -> int:
    """Returns the largest number of panels of a kind in a figure, at most two rows."""
    return min(MOST_PANELS, 2 * _across())


def panels_of_scales(
    rows: pd.DataFrame, look: Mapping[str, Look]
) -> tuple[Figure, list[tuple[Axes, pd.DataFrame]]]:
    """Makes a figure with a panel per error scale, or for some with both ends; returns it and the
    panels' rows."""
    every = sorted(set(rows["error_scale"]))
    count = min(most_panels(), len(every))
    scales = [every[round(i)] for i in np.linspace(0, len(every) - 1, count)]
    fig, axes = panels(len(scales), look)
    found = []
    for scale, ax in zip(scales, axes, strict=True):
        title(ax, f"error scale {value_text(scale)}")
        found.append((ax, rows[rows["error_scale"] == scale]))
    return fig, found


def left_out(scales: Sequence[float], panels: Sequence[Any]) -> str:
    """Says how many of the scales have panels, unless all have."""
    if len(panels) >= len(scales):
        return ""
    return f"Panels: {len(panels)} of {len(scales)} scales."


def text(value: Any) -> str:
    """Returns a name for use in a figure: never read as mathematics, never longer than a line. Of a
    longer one the beginning and the end stand, where options tell names apart."""
    return texts([value])[str(value)]


def together(items: Iterable[T], alike: Callable[[T, T], bool]) -> list[list[T]]:
    """Groups items, each with the first group whose first item is alike."""
    groups: list[list[T]] = []
    for one in items:
        same = [group for group in groups if alike(group[0], one)]
        if same:
            same[0].append(one)
        else:
            groups.append([one])
    return groups


def texts(names: Iterable[Any], most: int = 0) -> dict[str, str]:
    """Returns names for use in one figure, at most that long. Of longer ones that begin and end
    alike the beginning stands, and the place where they differ."""
    most = most or (16 if print_width() else 42)
    whole = [str(name) for name in names]
    short = {words: _ends(words, most) for words in whole}
    for alike in set(short.values()):
        same = [words for words in short if short[words] == alike]
        if len(same) > 1:
            letters = enumerate(zip(*same, strict=False))
            at = next((i for i, here in letters if len(set(here)) > 1), len(min(same, key=len)))
            short |= {words: _from(words, at, most) for words in same}
    return {words: _plain(cut) for words, cut in short.items()}


def _ends(words: str, most: int) -> str:
    if len(words) <= most:
        return words
    tail = words[-(most // 2) :].lstrip(_OF_NUMBERS)
    return f"{_cut(words, most - len(tail))}{tail}"


def _from(words: str, at: int, most: int) -> str:
    """Returns the beginning of a name and what stands in it from the word of that place on."""
    begin = words[: most // 4]
    start = max(words.rfind(" ", 0, at) + 1, at - most // 4)
    return f"{begin}…{_cut(words[start:], most - len(begin) - 1)}"


def _plain(words: str) -> str:
    words = words.replace(r"\$", "$").replace("$", r"\$")
    # A leading underscore would hide the name from legends.
    return f"\u200b{words}" if words.startswith("_") else words


def _cut(words: str, most: int) -> str:
    if len(words) > most:
        kept = words[: most - 1]
        if words[most - 1] in _OF_NUMBERS:
            # Half a number would read as another one.
            kept = kept.rstrip(_OF_NUMBERS)
        words = f"{kept}…"
    return words


def _size(name: Any) -> float:
    """Returns one of matplotlib's sizes of letters in points."""
    from matplotlib import rcParams

    return float(rcParams[name])


def _letters(inches: float, size: str) -> float:
    """Estimates how many letters of one of matplotlib's sizes fit that length."""
    return inches / (0.0085 * _size(size))


def _room(ax: Axes, size: str) -> float:
    """Estimates how many letters fit the width of a panel, before the layout."""
    across = ax.get_subplotspec().get_gridspec().ncols  # type: ignore[union-attr]
    width = ax.figure.get_figwidth() / across  # type: ignore[union-attr]
    names = 7
    if _value(ax) == "x":
        names = max((len(label.get_text()) for label in ax.get_yticklabels()), default=0)
    return _letters(width, size) - names


def title(ax: Axes, words: str) -> None:
    """Sets the title of a panel, in one line."""
    ax.set_title(_cut(words, title_letters(ax)).replace("$", r"\$"))


def titles(axes: Iterable[Axes], words: Sequence[str]) -> None:
    """Sets the titles of panels, shortened so that they are told apart."""
    panels = list(axes)[: len(words)]
    short = texts(words, min(map(title_letters, panels)))
    for ax, text in zip(panels, words, strict=True):
        ax.set_title(short[text])


def title_letters(ax: Axes) -> int:
    """Estimates how many letters fit a panel's title."""
    return max(12, int(_room(ax, "axes.titlesize")) + 3)


def axis_labels(fig: Figure, x: str, y: str) -> None:
    """Labels the axes of all panels alike, so that each can stand alone."""
    for ax in fig.axes:
        ax.set(xlabel=x, ylabel=y)


def number(value: float) -> str:
    """Formats a number of an axis: 0.005, 2000, 10⁴ or 5·10⁻⁷, with a typographic minus."""
    is_plain = 0.001 <= abs(value) < 1e4 or value == 0
    words, _, exponent = (f"{value:g}" if is_plain else f"{value:e}").partition("e")
    if exponent:
        power = str(int(exponent)).translate(_RAISED)
        words = f"{float(words):g}·10{power}".removeprefix("1·")
    return words.replace("-", "\N{MINUS SIGN}")


def scale_axis(ax: Axes, scales: Sequence[float], names: Iterable[str] = ()) -> None:
    """Sets a logarithmic axis with a tick at each of the ascending error scales; the names of
    curves beside one of the panels take of the width of all."""
    span = np.log10(scales[-1] / scales[0])
    margin = max(0.06 * span, 0.15)
    across = ax.get_subplotspec().get_gridspec().ncols  # type: ignore[union-attr]
    beside = min(_MOST_LETTERS, len(", ".join(names))) / across
    room = _room(ax, "xtick.labelsize") - beside
    kept = labelled(scales, (span + 2 * margin) / room)
    ax.set_xscale("log")
    ax.set_xticks(scales, [value_text(s) if s in kept else "" for s in scales])
    ax.set_xticks([], minor=True)
    ax.set_xlim(scales[0] / 10**margin, scales[-1] * 10**margin)
    ax.set_xlabel("error scale")


def labelled(scales: Sequence[float], letter: float) -> list[float]:
    """Selects ascending scales whose labels fit, a letter taking so many decades: both ends, and
    those between."""

    def fit(low: float, high: float) -> bool:
        letters = (len(value_text(low)) + len(value_text(high)) + 2) / 2
        return np.log10(high / low) > letter * letters

    kept = [scales[0]]
    for scale in scales[1:-1]:
        if fit(kept[-1], scale) and fit(scale, scales[-1]):
            kept.append(scale)
    return [*kept, *scales[1:][-1:]]


def decades(ax: Axes, values: Any, least: float = 10.0, *, ends: Any = ()) -> None:
    """Sets a logarithmic axis around the values that spans at least a decade, so that a scatter of
    1 % looks small.

    The `ends` of intervals widen it by no more than `REACH` of the values' own span, or a decade:
    those of heavy tails, which may be as wide as numbers go, end at the panel's edge.
    """
    values = _positive(values)
    ends = _positive(ends)
    if len(values) == 0:
        # A logarithmic axis without anything to show makes matplotlib warn.
        return
    low = values.min()
    high = values.max()
    room = max(least, (high / low) ** REACH)
    margin = min(1.6, least)
    bottom = max(low / room, ends.min(initial=low)) / margin
    top = min(high * room, ends.max(initial=high)) * margin
    wider = max(np.sqrt(least * bottom / top), 1.0)
    limits = (bottom / wider, top * wider)
    axis = _value(ax)
    ax.set(**{f"{axis}scale": "log", f"{axis}lim": limits})
    log_ticks(ax.xaxis if axis == "x" else ax.yaxis, *limits)


def _positive(values: Any) -> Array:
    values = np.asarray(values, dtype=float).ravel()
    return values[np.isfinite(values) & (values > 0)]


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Labels that do not crowd: powers of ten, and 2 and 5 between if those are few, or all digits
    within a factor of three."""
    from matplotlib.ticker import LogLocator, NullLocator

    ratio = high / low
    if ratio < 3:
        axis.set_major_locator(LogLocator(subs=range(1, 10)))
    elif ratio < 200:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    else:
        axis.set_major_locator(LogLocator(numticks=7))
    axis.set_major_formatter(lambda value, _: number(value))
    axis.set_minor_locator(NullLocator())


def full_ticks(ax: Axes, most: int = 4) -> None:
    """Labels the horizontal axis with whole numbers, of which no part is set aside at its end, as
    many as fit."""
    from matplotlib.ticker import MaxNLocator

    low, high = ax.get_xlim()
    room = _room(ax, "xtick.labelsize")
    for intervals in range(most, 1, -1):
        locator = MaxNLocator(intervals, steps=[1, 2, 5, 10])
        ticks = np.asarray(locator.tick_values(low, high))
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        step = np.diff(ticks).min(initial=1.0)
        decimals = -int(np.floor(np.log10(step) + 1e-9))
        labels = [f"{tick:.{decimals}f}".replace("-", "\N{MINUS SIGN}") for tick in ticks]
        ax.set_xticks(ticks.tolist(), labels)
        if sum(len(label) + 2 for label in labels) <= room:
            break


def shares(ax: Axes) -> None:
    """Sets an axis of shares from 0 to 1."""
    axis = _value(ax)
    ax.set(**{f"{axis}lim": (-0.03, 1.03)})
    of_values = ax.xaxis if axis == "x" else ax.yaxis
    of_values.set_major_formatter(lambda share, _: f"{100 * share:.0f} %")


def times(seconds: pd.Series[Any]) -> tuple[Array, str]:
    """Returns times in a unit in which they are short, and its axis's label."""
    at = seconds.to_numpy(float)
    last = float(np.abs(at).max())
    if last < 300:
        return at, "time [s]"
    return (at / 60, "time [min]") if last < 6 * 3600 else (at / 3600, "time [h]")


def bound_line(ax: Axes, at: float, label: str) -> None:
    draw = ax.axvline if _value(ax) == "x" else ax.axhline
    draw(at, color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0, label=label, zorder=1)


def band(ax: Axes, low: float, high: float, label: str = "") -> None:
    draw = ax.axvspan if _value(ax) == "x" else ax.axhspan
    draw(low, high, color=BOUND_COLOR, alpha=0.25, linewidth=0, label=label, zorder=0)


def beyond(ax: Axes, x: Any, y: Any, one: Look) -> None:
    """Draws points that lie beyond the axis at its end: hollow, with an arrow."""
    edge: dict[str, Any] = {"marker": one.marker, "markeredgecolor": one.color}
    ax.plot(x, y, clip_on=False, zorder=3, **edge, **_EMPTY)
    _arrows(ax, x, y, one.color, points=7)


def _arrows(
    ax: Axes, x: Any, y: Any, color: str, *, points: float, downwards: bool = False
) -> None:
    """Draws arrows towards the end of the axis of values, their middles so many points farther out,
    and says in the legend what they mean."""
    from matplotlib.transforms import ScaledTranslation

    inches = (-points if downwards else points) / 72
    if _value(ax) == "x":
        way = "left" if downwards else "right"
        shift = (inches, 0)
    else:
        way = "down" if downwards else "up"
        shift = (0, inches)
    outwards = ScaledTranslation(*shift, ax.figure.dpi_scale_trans)
    arrow: dict[str, Any] = {"marker": rf"$\{way}arrow$", "markersize": 8}
    arrow |= {"linestyle": "none", "markeredgewidth": 0.0}
    place: Any = {"transform": ax.transData + outwards, "clip_on": False, "zorder": 3}
    (drawn,) = ax.plot(x, y, color=color, **place, **arrow)
    drawn.set_in_layout(False)
    if BEYOND not in ax.get_legend_handles_labels()[1]:
        ax.plot([], [], label=BEYOND, color=BOUND_COLOR, **arrow)


def mark_cut(ax: Axes, place: Any, edge: float, color: str, *, downwards: bool) -> None:
    """Draws an arrow at the ends of intervals that are cut at the edge, each at its place."""
    if len(place) == 0:
        return
    edges = np.full(len(place), edge)
    at = (edges, place) if _value(ax) == "x" else (place, edges)
    _arrows(ax, *at, color, points=-4, downwards=downwards)


def lines(
    ax: Axes, rows: pd.DataFrame, x: str, y: str, look: Mapping[str, Look], **style: Any
) -> None:
    """Draws a line per estimator through dense points, grey ones below, with a few markers,
    staggered so that coinciding lines are seen."""
    there = set(rows["estimator"])
    drawn = {name: one for name, one in look.items() if name in there}
    grey_first = sorted(drawn, key=lambda name: drawn[name].color != GREY)
    for i, name in enumerate(grey_first):
        own = rows[rows["estimator"] == name]
        one = drawn[name]
        first = 0.05 + 0.25 * i / len(drawn)
        marked = [] if one.color == GREY else (first, 0.25)
        ax.plot(own[x], own[y], markevery=marked, **(one.line | style))


class _Points(NamedTuple):
    """The points of a curve, of which some are hollow and some lie over the axis."""

    place: Any
    value: Any
    hollow: Any
    over: Any


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
    most: float = np.inf,
    heading: str = "",
    label: str = "",
) -> None:
    """Draws a column over the error scales, a line with markers per label, on an axis with fixed
    limits, with the panel's heading and the label of its axis of values; at one scale a row per
    label of panels that were made for it.

    Labels in colour stand side by side about their scale, so that points and intervals that
    coincide are seen. A line is broken where a value is missing; a point that some of the trials or
    fewer than `FEW` carry is hollow, and without an interval if they are fewer than `FEW`. Of an
    interval that lacks an end the other is drawn. What exceeds `most` stands there, and an interval
    that is cut there or at the end of the axis has an arrow.
    """
    one_scale = len(scales) == 1
    least, top = _limits(ax)
    top = min(top, most)
    if not one_scale:
        scale_axis(ax, scales, look)
    elif _value(ax) == "y":
        ax.set_xticks([])
    gap = float(np.diff(np.log10(scales)).min(initial=1.0))
    colored = [name for name, one in look.items() if one.color != GREY]
    shifts = {name: (i + 0.5) / len(colored) - 0.5 for i, name in enumerate(colored)}
    all_trials = rows["trials"].max()
    hollow = False
    for i, (name, one) in enumerate(look.items()):
        part: Any = rows[rows[by] == name].sort_values("error_scale", kind="stable")
        beside = 10 ** (0.3 * gap * shifts.get(name, 0.0))
        place = np.full(len(part), i) if one_scale else part["error_scale"] * beside
        few = part[trials] < FEW
        over = part[y] > most
        empty = few | (part[trials] < all_trials)
        values = part[y].clip(upper=most)
        ends = None
        if interval and one.color != GREY:
            low, high = (part[end] for end in interval)
            ends = _lengths(values, low.clip(lower=least), high.clip(upper=top), few)
            shown = ~over & ~few
            mark_cut(ax, place[shown & (low < least)], least, one.color, downwards=True)
            mark_cut(ax, place[shown & (high > top)], top, one.color, downwards=False)
        line: dict[str, Any] = {**one.line, "zorder": 2}
        if one_scale:
            line["linestyle"] = "none"
        elif one.color == GREY:  # the background, where estimators are alike
            line |= {"marker": ",", "zorder": 1}
            empty &= False
        hollow |= bool(empty.any())
        _draw_curve(ax, _Points(place, values, empty, over), ends, name, one, line)
    if hollow:
        ax.plot([], [], marker="o", markeredgecolor=BOUND_COLOR, label=_HOLLOW, **_EMPTY)
    ax.set(**{f"{_value(ax)}label": label})
    if heading:
        title(ax, heading)


def _lengths(values: Any, low: Any, high: Any, few: Any) -> Array:
    """Returns how far intervals reach below and above their values (2, points), 0 on a side without
    an end; NaN without any end, or where trials are few."""
    lengths = np.array([values - low, high - values]).clip(min=0)
    known = np.isfinite(lengths) & ~few.to_numpy()
    missing = np.where(known.any(axis=0), 0.0, np.nan)
    return np.where(known, lengths, missing)


def _draw_curve(
    ax: Axes, points: _Points, ends: Array | None, name: str, one: Look, line: dict[str, Any]
) -> None:
    """Draws a curve with its intervals, then its hollow points and those over the axis, all marked
    with its name."""
    across = _value(ax) == "x"
    values = points.value.where(np.isfinite(points.value))
    right, up = (values, points.place) if across else (points.place, values)
    before = set(ax.get_children())
    line |= {"xerr" if across else "yerr": ends, "elinewidth": 0.8}
    ax.errorbar(right, up, **line)
    inside = points.hollow & ~points.over
    edge: dict[str, Any] = {"marker": one.marker, "markeredgecolor": one.color, "zorder": 3}
    ax.plot(right[inside], up[inside], **edge, **_EMPTY)
    if points.over.any():
        beyond(ax, right[points.over], up[points.over], one)
    own = [artist for artist in ax.get_children() if artist not in before]
    for number, artist in enumerate(own):
        mark_name(ax, artist, name, number)


def tiles(
    ax: Axes, places: Any, colors: Sequence[str], words: Any, letters: float, **style: Any
) -> None:
    """Draws a grid of cells in the colours at these places, NaN for none, with words in black or
    white."""
    import seaborn as sns
    from matplotlib.colors import ListedColormap

    style |= {"vmin": 0, "vmax": len(colors), "cmap": ListedColormap(list(colors))}
    sns.heatmap(places, ax=ax, annot=words, fmt="", cbar=False, **style)
    grounds = [colors[int(place)] for place in np.ravel(places) if np.isfinite(place)]
    for text, ground in zip(ax.texts, grounds, strict=True):
        text.set(color=ink(ground), fontsize=letters)


def mark_name(ax: Axes, artist: Artist, name: str, number: int) -> None:
    """Marks an artist, with a number among those of its panel and estimator, so that a page finds
    it by the name."""
    panel = ax.figure.axes.index(ax)
    artist.set_gid(f"{NAMED}{name}#{panel}-{number}")


def spread(wanted: Sequence[float], gap: float, low: float, high: float) -> Array:
    """Returns places at least `gap` apart from `low` to `high`, nearest to where they are
    wanted."""
    from scipy.optimize import isotonic_regression

    order = np.argsort(wanted, kind="stable")
    # Less these shifts, places that are `gap` apart only have to ascend.
    shifts = gap * np.arange(len(order))
    ascending = isotonic_regression(np.asarray(wanted, dtype=float)[order] - shifts).x
    highest = max(low, high - shifts[-1])
    found = np.empty(len(order))
    found[order] = np.clip(ascending, low, highest) + shifts
    return found


class _End(NamedTuple):
    """Where a curve ends."""

    scale: float
    value: float


def end_names(ax: Axes, rows: pd.DataFrame, y: str, look: Mapping[str, Look]) -> None:
    """Writes the name of each curve at its end, in its colour; curves that end at one place share a
    label."""
    from matplotlib.offsetbox import AnnotationBbox, HPacker

    known = rows[rows[y].notna()].sort_values("error_scale", kind="stable")
    last = known.groupby("estimator", sort=False).tail(1).set_index("estimator")
    named = [name for name in look if name in last.index]
    ends = {name: _End(last["error_scale"][name], last[y][name]) for name in named}
    labels = _shared(ends)
    short = texts(named)
    low, high = ax.get_ylim()
    size = _size("legend.fontsize")
    height = 72 * ax.figure.get_figheight() - _AROUND  # type: ignore[union-attr]
    firsts = [ends[names[0]] for names in labels]
    wanted = [(end.value - low) / (high - low) for end in firsts]
    places = spread(wanted, 1.3 * size / height, 0.0, 1.0)
    for names, end, place in zip(labels, firsts, places, strict=True):
        words = _named(ax, {name: short[name] for name in names}, look, size)
        box = AnnotationBbox(
            HPacker(children=words, pad=0, sep=0.3 * size, align="baseline"),
            end,
            (1.06, place),
            boxcoords="axes fraction",
            box_alignment=(0.0, 0.5),
            frameon=False,
            pad=0,
            annotation_clip=False,
            # To the left end of its name, across no other one.
            arrowprops={
                "arrowstyle": "-",
                "color": SOFT,
                "linewidth": 0.4,
                "shrinkB": 2,
                "relpos": (0.0, 0.5),
            },
        )
        ax.add_artist(box)


def _shared(ends: Mapping[str, _End]) -> list[list[str]]:
    """Returns the names of each label, the lowest first: those of curves that end at one place, as
    far as they fit."""
    labels: list[list[str]] = []
    for name in sorted(ends, key=lambda name: (ends[name].value, ends[name].scale)):
        if labels:
            near = np.allclose(ends[labels[-1][0]], ends[name], rtol=0, atol=_SAME_END)
            letters = len(", ".join([*labels[-1], name]))
            if near and letters <= _MOST_LETTERS:
                labels[-1].append(name)
                continue
        labels.append([name])
    return labels


def _named(ax: Axes, names: Mapping[str, str], look: Mapping[str, Look], size: float) -> list[Any]:
    """Returns the texts of the names of a label, each in its curve's colour and bold where that
    line is."""
    from matplotlib.offsetbox import TextArea

    words = []
    *_, last = names
    for name, short in names.items():
        one = look[name]
        color = SOFT if one.color == GREY else strong(one.color)
        style: Any = {"color": color, "fontsize": size}
        if one.width > 1:
            style["fontweight"] = "bold"
        comma = "" if name == last else ","
        words.append(TextArea(f"{short}{comma}", textprops=style))
        mark_name(ax, words[-1].get_children()[0], name, _TEXT)
    return words


def legend(
    fig: Figure,
    axes: Sequence[Axes],
    look: Mapping[str, Look] | None = None,
    *,
    points: bool = False,
) -> None:
    """Adds one legend above all panels: the estimators in colour unless their names stand on the
    axes, then the other labels in the panels."""
    from matplotlib.lines import Line2D

    on_axes = any(_value(ax) == "x" for ax in axes)
    named = {} if on_axes else look or {}
    short = texts(named)
    colored = {label: one for label, one in named.items() if one.color != GREY}
    plain: dict[str, Any] = {"linestyle": "none"} if points else {}
    handles: dict[str, Any] = {}
    for label, one in colored.items():
        handles[short[label]] = Line2D([], [], **one.line | plain)
    others = len(named) - len(colored)
    if others:
        handles[f"{others} others"] = Line2D([], [], color=GREY)
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if not handles:
        return
    lengths = np.array([7 + len(label) for label in handles])
    room = _letters(fig.get_figwidth(), "legend.fontsize")
    counts = range(1, len(handles) + 1)
    fitting = [columns for columns in counts if _width(lengths, columns) <= room]
    rows = -(-len(handles) // max(fitting, default=1))
    columns = -(-len(handles) // rows)
    place = "outside upper center"
    fig.legend(list(handles.values()), list(handles), loc=place, ncols=columns)


def _width(lengths: Array, columns: int) -> int:
    """Returns the letters of so many columns side by side, each as wide as its longest label."""
    return sum(part.max() for part in np.array_split(lengths, columns))
