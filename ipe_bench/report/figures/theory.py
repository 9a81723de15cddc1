"""Theory beside experiment: what least squares should come to, as curves through what it came to."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH
from ipe_bench.report.words import plain
from ipe_bench.statistics.summary import ALL
from ipe_bench.trials.second_order import LINEAR
from ipe_bench.trials.thresholds import FEW

MOST_PARAMETERS = 30
_WAYS = (("curvature_intrinsic", "intrinsic", "o"), ("curvature_parameter", "parameter effects", "s"))


def draw(view: View) -> Iterator[Drawing]:
    rows = view["summary"]
    rows = rows.assign(solved_trials=(rows["solved"] * rows["trials"]).round())
    rows = rows[rows["predicted_rmse"].notna() & (rows["solved_trials"] >= FEW)]
    if rows.empty or view.n > MOST_PARAMETERS:
        return
    look = view.with_look(rows["estimator"])
    across = len(view.scales) > 1
    fig = common.figure(10.5 if across else 6.4, 3.8)
    axes = list(fig.subplots(1, 3 if across else 1, squeeze=False, width_ratios=(1.6, 1, 1) if across else (1,)).flat)
    scale = max(rows["error_scale"])
    _by_parameter(axes[0], common.at_scale(rows, scale), look, view)
    if across:
        _over_scales(axes[1], rows[rows["parameter"] == ALL], look, view)
        _curvatures(axes[2], rows[rows["parameter"] == ALL], view)
    common.legend_below(fig, axes, look)
    yield Drawing(f"theory{view.suffix}", "Theory beside experiment", _caption(rows, scale, across, view), fig)


def _by_parameter(ax: Any, rows: pd.DataFrame, look: Any, view: View) -> None:
    """Each parameter's error over its Cramér-Rao bound, with what theory expects of it."""
    rows = rows[rows["parameter"] != ALL]
    names = [p["name"] for p in view.parameters]
    place = {name: i for i, name in enumerate(names)}
    bounds = rows["crlb"].to_numpy(dtype=float)
    ratios = {c: rows[c].to_numpy(dtype=float) / bounds for c in ("rmse", "rmse_low", "rmse_high", "predicted_rmse")}
    common.decades(ax, np.concatenate([*ratios.values(), [1.0]]), 3.0)
    for k, (label, one) in enumerate(look.items()):
        here = (rows["estimator"] == label).to_numpy()
        x = rows["parameter"].map(place).to_numpy(dtype=float)[here] + 0.5 * ((k + 1) / (len(look) + 1) - 0.5)
        ax.vlines(x, ratios["rmse_low"][here], ratios["rmse_high"][here], color=one.color, linewidth=1.2)
        ax.plot(x, ratios["rmse"][here], **{**one.line, "linestyle": "none", "markersize": 4.5})
        ax.hlines(ratios["predicted_rmse"][here], x - 0.2, x + 0.2, color="black", linewidth=1.6, zorder=4)
    ax.plot([], [], color="black", linewidth=1.6, label="theory")
    common.bound_line(ax, 1.0, "Cramér-Rao bound")
    ax.set_xticks(range(len(names)), [common.text(name) for name in names], rotation=90)
    ax.set_xlim(-0.6, len(names) - 0.4)
    ax.set(ylabel="rms error / bound", title=f"error scale {plain(float(rows['error_scale'].iloc[0]))}")


def _over_scales(ax: Any, totals: pd.DataFrame, look: Any, view: View) -> None:
    """All parameters together over the error scales."""
    values = totals[["rmse", "rmse_low", "rmse_high", "predicted_rmse", "crlb"]].to_numpy(dtype=float)
    common.decades(ax, values.ravel(), 3.0)
    common.curves(ax, totals, "rmse", look, view.scales, interval=("rmse_low", "rmse_high"))
    for line in ax.lines[:]:
        line.set_linestyle("none")
    first = totals.drop_duplicates("error_scale").sort_values("error_scale")
    ax.plot(first["error_scale"], first["predicted_rmse"], color="black", linewidth=1.6, zorder=2)
    ax.plot(first["error_scale"], first["crlb"], color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0)
    ax.set(ylabel="rms error / linear bound", title="all parameters")


def _curvatures(ax: Any, totals: pd.DataFrame, view: View) -> None:
    first = totals.drop_duplicates("error_scale").sort_values("error_scale")
    values = first[[name for name, *_ in _WAYS]].to_numpy(dtype=float)
    common.scale_axis(ax, view.scales, [])
    common.decades(ax, np.append(values.ravel(), LINEAR))
    for (name, words, marker), color in zip(_WAYS, ("#009E73", "#CC79A7"), strict=True):
        ax.plot(
            first["error_scale"], first[name], color=color, marker=marker, markersize=4.5, label=f"{words} curvature"
        )
    ax.axhline(LINEAR, color="#C00000", linewidth=1.0, label="where linear theory ends")
    ax.set(ylabel="relative curvature", title="how much the model bends")


def _caption(rows: pd.DataFrame, scale: float, across: bool, view: View) -> str:
    each = rows[rows["parameter"] != ALL]
    inside = (each["rmse_low"] <= each["predicted_rmse"]) & (each["predicted_rmse"] <= each["rmse_high"])
    return common.sentence(
        "Root mean square error of least squares over solved trials, with 95 % bootstrap intervals, and what theory"
        " expects: no noise is drawn for it. Where readings come from another model than is assumed, that is the"
        " distance to the parameters that fit them best and the asymptotic error of least squares about these; else the"
        " Cramér-Rao bound and the bias of second order.",
        f"{'Left: each' if across else 'Each'} parameter over its Cramér-Rao bound at error scale"
        f" {plain(float(scale))}.",
        "Middle: all parameters. Right: relative curvature at the truth within the region of the bound, which says"
        " nothing of false roots farther away."
        if across
        else "",
        f"Theory lies inside {int(inside.sum())} of {len(each)} intervals. {view.label}.",
    )


FIGURE = Figure(draw, ("summary",))
