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
from ipe_bench.trials.thresholds import FEW

MOST_PARAMETERS = 30


def draw(view: View) -> Iterator[Drawing]:
    rows = view["summary"]
    rows = rows.assign(solved_trials=(rows["solved"] * rows["trials"]).round())
    rows = rows[rows["predicted_rmse"].notna() & (rows["solved_trials"] >= FEW)]
    if rows.empty or view.n > MOST_PARAMETERS:
        return
    look = view.with_look(rows["estimator"])
    across = len(view.scales) > 1
    fig, axes = common.panels(2 if across else 1, look, height=3.0)
    scale = max(rows["error_scale"])
    _by_parameter(axes[0], common.at_scale(rows, scale), look, view)
    if across:
        _over_scales(axes[1], rows[rows["parameter"] == ALL], look, view)
    common.legend(fig, axes, look)
    yield Drawing(f"theory{view.suffix}", "Theory beside experiment, solved trials", _caption(rows, scale, view), fig)


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
        ax.plot(x, ratios["rmse"][here], **{**one.line, "linestyle": "none", "markersize": 3.5})
        ax.hlines(ratios["predicted_rmse"][here], x - 0.2, x + 0.2, color="black", linewidth=1.4, zorder=4)
    ax.plot([], [], color="black", linewidth=1.4, label="theory")
    common.bound_line(ax, 1.0, "Cramér-Rao bound")
    ax.set_xticks(range(len(names)), [common.text(name) for name in names], rotation=90)
    ax.set_xlim(-0.6, len(names) - 0.4)
    ax.set_ylabel("rms error / bound")
    common.title(ax, f"error scale {plain(float(rows['error_scale'].iloc[0]))}")


def _over_scales(ax: Any, totals: pd.DataFrame, look: Any, view: View) -> None:
    """All parameters together over the error scales."""
    values = totals[["rmse", "rmse_low", "rmse_high", "predicted_rmse", "crlb"]].to_numpy(dtype=float)
    common.decades(ax, values.ravel(), 3.0)
    interval = ("rmse_low", "rmse_high")
    common.curves(ax, totals, "rmse", look, view.scales, interval=interval, trials="solved_trials")
    first = totals.drop_duplicates("error_scale").sort_values("error_scale")
    ax.plot(first["error_scale"], first["predicted_rmse"], color="black", linewidth=1.4, zorder=2)
    ax.plot(first["error_scale"], first["crlb"], color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0)
    ax.set_ylabel("rms error / bound")
    common.title(ax, "all parameters, over the linear bound")


def _caption(rows: pd.DataFrame, scale: float, view: View) -> str:
    across = len(view.scales) > 1
    each = rows[rows["parameter"] != ALL]
    inside = (each["rmse_low"] <= each["predicted_rmse"]) & (each["predicted_rmse"] <= each["rmse_high"])
    return common.sentence(
        "Root mean square error of least squares over solved trials, with 95 % bootstrap intervals, and what theory"
        " expects: no noise is drawn for it. If readings come from another model than is assumed, that is the distance"
        " to the parameters that fit them best and the asymptotic error of least squares about these; else the"
        " Cramér-Rao bound and the bias of second order.",
        f"{'First: each' if across else 'Each'} parameter over its Cramér-Rao bound at error scale"
        f" {plain(float(scale))}.",
        "Second: all parameters." if across else "",
        f"Theory lies inside {int(inside.sum())} of {len(each)} intervals. {view.label}.",
    )


FIGURE = Figure(draw, ("summary",))
