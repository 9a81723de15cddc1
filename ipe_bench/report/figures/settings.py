"""Draws a sweep of settings whose readings come from other models, a row for each with its error
and how often its misfit is detected, or an axis of the one number that is swept; the matrix shows
other settings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.errors import BARS, draw_panels
from ipe_bench.report.figures.views import Figure, View, in_focus
from ipe_bench.report.finding import setting_words
from ipe_bench.report.style import FAMILIES, WHITE, Look
from ipe_bench.report.tables.settings import RIGHT, Wording, is_of_truth, last_words
from ipe_bench.report.words import brief, percent, value_text, varying
from ipe_bench.trials.thresholds import DETECTED

MOST_ROWS = 25
"""Settings that have a row; the tables have all."""
_ALIKE = 0.05
"""Part by which the errors of estimators that are alike differ at most."""
_MOST_ERROR = 1e4
"""Errors beyond are drawn here."""
_WIDTH = 4.2
"""Inches of the figure: its letters are read on a phone."""
_LETTERS = 56
"""Length of a line above a row."""
_COLORS = {
    "undetected": FAMILIES["filters"][0],
    "detected": FAMILIES["least squares"][0],
    "right": FAMILIES["IPE"][3],
}


def draw(view: View) -> Iterator[Drawing]:
    """Draws several settings at the largest error scale that most of them have."""
    columns = list(view["summary"].columns)
    columns = columns[: columns.index("error_scale")]
    listed: list[Any] = view.totals.to_dict("records")
    apart = varying(columns, listed)
    if not apart:
        return
    wording = Wording.of(view.collection)
    names = [setting_words(words) for words in wording.settings(listed, columns)]
    rows = _at_shared_scale(view.totals.assign(setting=_told_apart(names, listed, apart)))
    if rows["setting"].nunique() < 2:
        return
    if any(map(is_of_truth, apart)) and rows["misfit"].notna().any():
        yield _bars(view, rows)
    elif len(apart) == 1 and _is_axis(rows[apart[0]]):
        yield _swept(view, rows, apart[0], wording.units.get(apart[0], ""))


def _told_apart(
    names: list[str], rows: Sequence[Mapping[str, Any]], apart: Sequence[str]
) -> list[str]:
    """Returns the names of the rows' settings, or all their options: settings whose words are alike
    are different all the same."""
    options = [", ".join(f"{c}={value_text(row[c])}" for c in apart) for row in rows]
    return names if len(set(names)) == len(set(options)) else options


def _at_shared_scale(rows: pd.DataFrame) -> pd.DataFrame:
    """Selects the rows at the largest of the error scales that most settings have."""
    settings = rows.groupby("error_scale")["setting"].nunique()
    shared = settings.index[settings == settings.max()]
    return rows[rows["error_scale"] == max(shared)]


def _is_axis(values: pd.Series[Any]) -> bool:
    """Whether a setting is a positive number with three values or more, so that an axis can have
    it."""
    numbers = pd.to_numeric(values, errors="coerce")
    return numbers.nunique() > 2 and bool((numbers > 0).all())


def _swept(view: View, rows: pd.DataFrame, column: str, unit: str) -> Drawing:
    """Draws success, error and NEES over the number that is swept."""
    (scale,) = set(rows["error_scale"])
    rows = rows.assign(error_scale=pd.to_numeric(rows[column]))
    values = sorted(set(rows["error_scale"]))
    look = in_focus(view.look, view.focus)
    fig, axes = common.panels(3, look, height=3.3, row=3)
    draw_panels(view, axes, rows, look, values)
    for ax in axes:
        ax.set_xlabel(f"{last_words(column)} [{unit}]" if unit else column)
    common.end_names(axes[0], rows, "success", look)
    common.legend(fig, axes)
    title = f"Success, error and reported covariance over {column} at error scale {scale:g}"
    return view.drawing(fig, "settings", title, BARS)


def _bars(view: View, rows: pd.DataFrame) -> Drawing:
    """Draws the error of the best estimator as a bar for each setting, model errors that are not
    detected first, and writes beside it in how many trials the misfit is detected."""
    (scale,) = set(rows["error_scale"])
    errors = rows.pivot_table("error_median", "setting", "estimator")
    best = next((label for label in view.focus if label in errors), errors.columns[0])
    own = _sorted(rows[rows["estimator"] == best])
    look = {str(name): Look(_COLORS[kind], "o") for name, kind in own["kind"].items()}
    fig, (ax,) = common.panels(1, look, scales=[scale])
    shown = own["error_median"].clip(upper=_MOST_ERROR)
    common.decades(ax, shown, ends=own["error_q95"])
    common.bound_line(ax, 1.0, "1: the bound")
    ends: Any = {"interval": ("error_median", "error_q95"), "most": _MOST_ERROR}
    words: Any = {"by": "setting", "label": "error over the bound"}
    common.curves(ax, own.reset_index(), "error_median", look, [scale], **words, **ends)
    bar: Any = {"linewidth": 7.0, "alpha": 0.35, "solid_capstyle": "butt", "zorder": 1}
    for i, (error, one) in enumerate(zip(shown, look.values(), strict=True)):
        ax.plot([1.0, error], [i, i], color=one.color, **bar)
    ratios = errors.div(errors[best], axis=0)
    alike = len(errors.columns) > 1 and bool((abs(ratios - 1) <= _ALIKE).all(axis=None))
    ax.set_title(f"all {len(errors.columns)} estimators" if alike else best)
    ax.set_yticks([])
    ax.set_ylim(len(look) - 0.6, -1.0)
    lines = [_write(ax, i, own.loc[name], look[name].color) for i, name in enumerate(look)]
    fig.set_size_inches(_WIDTH, 1.2 + (0.4 + 0.16 * max(lines)) * len(look))
    common.legend(fig, [ax])
    return view.drawing(
        fig,
        "settings",
        f"Which model errors the test of fit detects, at error scale {scale:g}",
        "Bar: median error over the bound; line: to the 95 % quantile. At the right: trials in"
        " which the test rejects the model; red: under half.",
    )


def _sorted(rows: pd.DataFrame) -> pd.DataFrame:
    """Returns the rows of an estimator by their settings, with the `kind` of each: those that are
    not detected first, and of a kind the largest errors, at most `MOST_ROWS`."""
    rows = rows.set_index("setting")
    kinds = [_kind(str(name), share) for name, share in rows["misfit"].items()]
    rows = rows.assign(kind=pd.Categorical(kinds, list(_COLORS)))
    return rows.sort_values(["kind", "error_median"], ascending=[True, False]).iloc[:MOST_ROWS]


def _kind(name: str, detected: float) -> str:
    if name.endswith(RIGHT):
        return "right"
    return "detected" if detected >= DETECTED else "undetected"


def _write(ax: Any, i: int, row: Any, color: str) -> int:
    """Writes the error of a row at its mark, above it its setting and beside it in how many trials
    its misfit is detected; returns the number of lines of the setting."""
    style: Any = {"color": color, "textcoords": "offset points", "annotation_clip": False}
    # Behind letters no line is seen.
    style |= {"bbox": {"facecolor": WHITE, "edgecolor": "none", "pad": 1.0}}
    at = min(row["error_median"], _MOST_ERROR)
    if np.isfinite(at):
        ax.annotate(brief(row["error_median"]), (at, i), xytext=(0, -12), ha="center", **style)
    style["xycoords"] = ("axes fraction", "data")
    lines = textwrap.wrap(str(row.name), _LETTERS)
    setting = "\n".join(lines).replace("$", r"\$")
    ax.annotate(setting, (0, i), xytext=(2, 8), va="bottom", **style)
    weight = "bold" if row["kind"] == "undetected" else "normal"
    detected = f"detected\n{percent(row['misfit'])}"
    ax.annotate(detected, (1, i), xytext=(6, 0), va="center", fontweight=weight, **style)
    return len(lines)


FIGURES = (Figure(draw, ("summary",), together=True, main=True),)
