"""Draws how often estimators succeed at each error scale: one idea, read from afar, with names at
the curves; README shows it, on white and on a dark page."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.finding import Finding
from ipe_bench.report.style import DARK, REFERENCE, WHITE
from ipe_bench.report.tables.matrix import SUCCESS
from ipe_bench.report.words import enumerate_few, from_to, value_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

MOST_CURVES = 8
FAMILY = {
    "IPE": ("#2563eb", "#58a6ff"),
    "filters": ("#c2410c", "#f08a4b"),
    "least squares": ("#a3347f", "#f0a5d0"),
    "smoothers": ("#a3347f", "#f0a5d0"),
}
"""Colours of families on white and on a dark page, told apart with every kind of colour blindness;
the others are grey."""
GREY = ("#9aa1a8", "#6e7681")
INK = ("#16191d", WHITE)
SOFT = ("#57606a", "#9da7b1")
LINE = ("#d8dee4", "#30363d")
GROUND = (WHITE, DARK)
DASHES: tuple[Any, ...] = ("-", (0, (4, 1.6)), (0, (1.2, 1.4)), (0, (6, 1.6, 1.2, 1.6)))
"""Lines of those of one colour."""
MARKERS = "os"
"""Markers of the first of one colour, and of those for whom no line is left."""
_KNOWN = ("fixed_point", "ekf", "ukf", "levenberg_marquardt", REFERENCE)
"""Those whose curves are drawn after the best of each family, where not all have room."""
_LETTERS = 15
"""Points of the letters: 10 pixels where the picture is 390 wide."""
_TITLE = 20
_SIZE = (8.0, 5.0)
_RIGHT = 0.635
"""The part of the width where the curves end and their names begin."""
_TOP = 0.76
_BOTTOM = 0.15
_LONGEST = 46
"""Letters of a line of the title."""


@dataclass(frozen=True)
class Curve:
    """How one estimator is drawn."""

    color: str
    letters: str
    """The colour of its name, which is read: a contrast of 4.5."""
    dash: Any
    width: float
    marker: str = "o"


def draw(view: View) -> Iterator[Drawing]:
    """Draws success over the error scales, unless there is one alone."""
    if len(view.scales) < 2:
        return
    figure = picture(view)
    rows = view.totals
    shown = chosen(rows, view.families)
    absent = [name for name in dict.fromkeys(rows["estimator"]) if name not in shown]
    left_out = f"Not drawn: {enumerate_few(absent, 12)}." if absent else ""
    bars = "Bars: 95 % intervals."
    yield view.drawing(figure, SUCCESS, "Successful trials over error scales", bars, left_out)


def picture(view: View, *, dark: bool = False) -> Canvas:
    """Draws it on white or on a dark page."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure as Canvas

    rows = view.totals
    names = chosen(rows, view.families)
    curves = _curves(names, view.families, dark)
    look: Any = {"font.size": _LETTERS, "text.color": INK[dark], "axes.labelcolor": SOFT[dark]}
    with rc_context(look):
        figure = Canvas(figsize=_SIZE, dpi=200, facecolor=GROUND[dark])
        ax = figure.subplots()
        figure.subplots_adjust(left=0.115, right=_RIGHT, top=_TOP, bottom=_BOTTOM)
        for name in reversed(names):
            _draw_curve(ax, rows[rows["estimator"] == name], curves[name], GROUND[dark])
        _axes(ax, view.scales, dark)
        _names(ax, rows, curves)
        _title(figure, rows, SOFT[dark])
    return figure


def chosen(rows: pd.DataFrame, families: Mapping[str, str], most: int = MOST_CURVES) -> list[str]:
    """Returns the estimators that have a curve, the best first: all if there is room, or the best
    of each family and those that everyone knows."""
    listed: Any = rows.to_dict("records")
    ranked = [one.label for one in Finding.of(listed).standings]
    if len(ranked) <= most:
        return ranked
    best: dict[str, str] = {}
    for name in ranked:
        if name != REFERENCE:
            best.setdefault(families.get(name, ""), name)
    known = [name for name in _KNOWN if name in ranked]
    kept = list(dict.fromkeys([*best.values(), *known, *ranked]))[:most]
    return [name for name in ranked if name in kept]


def _curves(names: list[str], families: Mapping[str, str], dark: bool) -> dict[str, Curve]:
    """Returns the looks: the first in ink and thick, and each family in its colour."""
    found = {}
    members: dict[str, int] = {}
    for at, name in enumerate(names):
        family = "" if name == REFERENCE else families.get(name, "")
        if at == 0:
            found[name] = Curve(INK[dark], INK[dark], "-", 5.0)
            continue
        color = FAMILY.get(family, GREY)[dark]
        number = members.get(color, 0)
        members[color] = number + 1
        letters = color if family in FAMILY else SOFT[dark]
        marker = MARKERS[number // len(DASHES)]
        found[name] = Curve(color, letters, DASHES[number % len(DASHES)], 2.6, marker)
    return found


def _draw_curve(ax: Any, rows: pd.DataFrame, curve: Curve, ground: str) -> None:
    x = rows["error_scale"]
    y = 100 * rows["success"]
    # At all and at none intervals would lie on each other.
    between = (y > 0.5) & (y < 99.5)
    low = y - 100 * rows["success_low"]
    high = 100 * rows["success_high"] - y
    ends = [low[between], high[between]]
    bars: Any = {"fmt": "none", "ecolor": curve.color, "elinewidth": 1.4, "alpha": 0.7}
    ax.errorbar(x[between], y[between], yerr=ends, **bars)
    line: Any = {"color": curve.color, "linewidth": curve.width, "linestyle": curve.dash}
    line |= {"marker": curve.marker, "markersize": curve.width + 3.4, "markeredgecolor": ground}
    ax.plot(x, y, markeredgewidth=1.2, clip_on=False, **line)


def _axes(ax: Any, scales: list[float], dark: bool) -> None:
    ax.set_facecolor(GROUND[dark])
    ax.set_xscale("log")
    ax.set(xlim=(scales[0] / 1.15, scales[-1]), ylim=(-3, 103))
    tens = [scale for scale in scales if math.log10(scale).is_integer()]
    # Labels of neighbours would overlap.
    kept = tens if len(tens) > 2 else common.labelled(scales, 0.16)
    ax.set_xticks(kept, [value_text(scale) for scale in kept])
    ax.set_xticks([], minor=True)
    ax.set_yticks([0, 50, 100], ["0", "50", "100 %"])
    ax.tick_params(length=0, labelsize=_LETTERS, colors=SOFT[dark], pad=6)
    label = "error scale: error of the start / usual error"
    ax.set_xlabel(label, fontsize=_LETTERS, labelpad=6, loc="left")
    ax.grid(visible=False, axis="x")
    ax.grid(axis="y", color=LINE[dark], linewidth=1)
    ax.set_axisbelow(True)
    ax.spines[:].set_visible(False)


def _names(ax: Any, rows: pd.DataFrame, curves: Mapping[str, Curve]) -> None:
    """Writes each name beside the end of its curve, led to by a piece of its line."""
    last = rows.groupby("estimator").tail(1).set_index("estimator")
    # Of curves that end together the better stands above.
    order = sorted(curves, key=lambda name: last["success"][name], reverse=True)
    low, high = ax.get_ylim()
    wanted = [(100 * last["success"][name] - low) / (high - low) for name in reversed(order)]
    height = 72 * _SIZE[1] * (_TOP - _BOTTOM)
    short = common.texts(order)
    gap = 1.25 * _LETTERS / height
    places = common.spread(wanted, gap, 0.0, 1.0)
    for name, place in zip(reversed(order), places, strict=True):
        curve = curves[name]
        end = (last["error_scale"][name], 100 * last["success"][name])
        lead: Any = {"arrowstyle": "-", "color": curve.color, "linestyle": curve.dash}
        lead |= {"linewidth": min(curve.width, 2.0), "shrinkA": 3, "shrinkB": 4}
        lead |= {"relpos": (0.0, 0.5)}
        ax.annotate(
            short[name],
            end,
            (1.08, place),
            textcoords="axes fraction",
            ha="left",
            va="center",
            fontsize=_LETTERS,
            fontweight="bold" if curve.width > 3 else "normal",
            color=curve.letters,
            arrowprops=lead,
            annotation_clip=False,
        )


def _title(figure: Canvas, rows: pd.DataFrame, soft: str) -> None:
    """Writes who succeeds up to where, and what the curves are."""
    listed: Any = rows.to_dict("records")
    found = Finding.of(listed).sentence().partition(" (")[0].partition("; ")[0]
    # The picture may show some of the estimators alone.
    found = re.sub(r"^(?:Of these \d+, only|Only) ", "", found)
    lines = textwrap.wrap(found, _LONGEST)[:2]
    alone = len(lines) == 1
    size = _TITLE if alone else _TITLE - 3
    top = 0.965 if alone else 0.985
    heading: Any = {"fontsize": size, "fontweight": "bold", "va": "top", "linespacing": 1.1}
    figure.text(0.02, top, "\n".join(lines).replace("$", r"\$"), **heading)
    number = from_to(map(int, rows["trials"]))
    told = f"successful trials, % of {number} (bars: 95 % intervals)"
    figure.text(0.02, 0.85, told, fontsize=_LETTERS, color=soft, va="center")


FIGURES = (Figure(draw, ("summary",), main=True),)
