"""Draws a sweep of settings whose readings come from other models, a row for each with its error
and how often its misfit is detected, or an axis of the one number that is swept; the matrix shows
other settings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.errors import BARS, draw_panels
from ipe_bench.report.figures.views import Figure, View, in_focus
from ipe_bench.report.finding import setting_words
from ipe_bench.report.style import FAMILIES, WHITE, Look
from ipe_bench.report.tables.settings import RIGHT, Wording, last_words
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
    rows = view.totals
    listed: list[Any] = rows.to_dict("records")
    apart = varying(columns, listed)
    if not apart:
        return
    wording = Wording.of(view.collection)
    words = wording.settings(listed, columns)
    names = [setting_words(setting) for setting in words]
    keys = [
        ", ".join(f"{column}={value_text(value)}" for column, value in row.items())
        for row in rows[apart].to_dict("records")
    ]
    # Settings whose words are alike are different all the same.
    rows = rows.assign(setting=names if len(set(names)) == len(set(keys)) else keys)
    at = rows.groupby("error_scale")["setting"].nunique()
    shared = at.index[at == at.max()]
    if at.max() < 2:
        return
    scale = max(shared)
    rows = rows[rows["error_scale"] == scale]
    of_truth = any(column.partition(".")[0] == "truth" for column in apart)
    if of_truth and rows["misfit"].notna().any():
        yield from _rows(view, rows, scale)
    elif len(apart) == 1 and _is_axis(rows[apart[0]]):
        unit = wording.units.get(apart[0], "")
        yield from _swept(view, rows, apart[0], unit, scale)


def _is_axis(values: pd.Series[Any]) -> bool:
    """Whether a setting is a positive number with three values or more, so that an axis can have
    it."""
    numbers = pd.to_numeric(values, errors="coerce")
    return numbers.nunique() > 2 and bool((numbers > 0).all())


def _swept(
    view: View, rows: pd.DataFrame, column: str, unit: str, scale: float
) -> Iterator[Drawing]:
    """Draws success, error and NEES over the number that is swept."""
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
    yield view.drawing(fig, "settings", title, BARS)


def _rows(view: View, rows: pd.DataFrame, scale: float) -> Iterator[Drawing]:
    """Draws the error of the best estimator as a bar for each setting, model errors that are not
    detected first, and writes beside it in how many trials the misfit is detected."""
    errors = rows.pivot_table("error_median", "setting", "estimator")
    best = next((label for label in view.focus if label in errors), errors.columns[0])
    own = rows[rows["estimator"] == best].set_index("setting")
    kinds = [_kind(str(name), share) for name, share in own["misfit"].items()]
    own = own.assign(kind=kinds, order=[list(_COLORS).index(kind) for kind in kinds])
    own = own.sort_values(["order", "error_median"], ascending=[True, False]).iloc[:MOST_ROWS]
    look = {str(name): Look(_COLORS[kind], "o") for name, kind in own["kind"].items()}
    fig, (ax,) = common.panels(1, look, scales=[scale])
    common.decades(ax, own["error_median"].clip(upper=_MOST_ERROR), ends=own["error_q95"])
    common.bound_line(ax, 1.0, "1: the bound")
    ends: Any = {"interval": ("error_median", "error_q95"), "most": _MOST_ERROR}
    words: Any = {"by": "setting", "label": "error over the bound"}
    common.curves(ax, own.reset_index(), "error_median", look, [scale], **words, **ends)
    bars = zip(own["error_median"].clip(upper=_MOST_ERROR), look.values(), strict=True)
    for i, (error, one) in enumerate(bars):
        bar: Any = {"color": one.color, "linewidth": 7.0, "alpha": 0.35}
        ax.plot([1.0, error], [i, i], solid_capstyle="butt", zorder=1, **bar)
    ratios = errors.div(errors[best], axis=0)
    alike = len(errors.columns) > 1 and bool((abs(ratios - 1) <= _ALIKE).all(axis=None))
    ax.set_title(f"all {len(errors.columns)} estimators" if alike else best)
    ax.set_yticks([])
    ax.set_ylim(len(look) - 0.6, -1.0)
    deepest = _write(ax, own, look)
    fig.set_size_inches(_WIDTH, 1.2 + (0.4 + 0.16 * deepest) * len(look))
    common.legend(fig, [ax])
    yield view.drawing(
        fig,
        "settings",
        f"Which model errors the test of fit detects, at error scale {scale:g}",
        "Bar: median error over the bound; line: to the 95 % quantile. At the right: trials in"
        " which the test rejects the model; red: under half.",
    )


def _kind(name: str, detected: float) -> str:
    if name.endswith(RIGHT):
        return "right"
    return "detected" if detected >= DETECTED else "undetected"


def _write(ax: Any, rows: pd.DataFrame, look: Mapping[str, Look]) -> int:
    """Writes each error at its mark, above each row its setting and beside it in how many trials
    its misfit is detected; returns the largest number of lines."""
    most = 1
    for i, (name, one) in enumerate(look.items()):
        row: Any = rows.loc[name]
        style: Any = {"color": one.color, "textcoords": "offset points", "annotation_clip": False}
        # Behind letters no line is seen.
        style |= {"bbox": {"facecolor": WHITE, "edgecolor": "none", "pad": 1.0}}
        at = min(row["error_median"], _MOST_ERROR)
        if np.isfinite(at):
            ax.annotate(brief(row["error_median"]), (at, i), xytext=(0, -12), ha="center", **style)
        lines = textwrap.wrap(str(name), _LETTERS)
        place: Any = {"xycoords": ("axes fraction", "data")}
        above: Any = {"xytext": (2, 8), "va": "bottom", **place}
        ax.annotate("\n".join(lines).replace("$", r"\$"), (0, i), **above, **style)
        weight = "bold" if row["kind"] == "undetected" else "normal"
        beside: Any = {"xytext": (6, 0), "va": "center", "fontweight": weight, **place}
        ax.annotate(f"detected\n{percent(row['misfit'])}", (1, i), **beside, **style)
        most = max(most, len(lines))
    return most


FIGURES = (Figure(draw, ("summary",), together=True, main=True),)
