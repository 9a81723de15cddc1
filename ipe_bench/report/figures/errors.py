"""The headline: success, error and honesty of all trials."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR
from ipe_bench.report.words import percent, plain

CEILING = {"error_median": 100.0, "error_q95": 100.0, "nees_median": 30.0}
"""What lies beyond is drawn there: how far a diverged estimate is off tells nothing, and the bound needs the room."""


def draw(view: View) -> Iterator[Drawing]:
    totals = view.totals
    if totals.empty:
        return
    beyond = bool((totals[list(CEILING)] > pd.Series(CEILING)).any(axis=None))
    totals = totals.assign(**{name: totals[name].clip(upper=most) for name, most in CEILING.items()})
    claims = totals[totals["nees_median"].notna()]
    fig, axes = common.panels(3 if len(claims) else 2, view.look, height=3.3)
    shown = view.look, view.scales
    words: dict[str, Any] = {"heading": "success", "label": "share of all trials"}
    common.shares(axes[0], "")
    common.curves(axes[0], totals, "success", *shown, interval=("success_low", "success_high"), **words)
    words = {"heading": "error over the bound", "label": "median, bar to 95 %"}
    common.decades(axes[1], totals[["error_median", "error_q95"]].clip(lower=0.5), least=4.0)
    common.bound_line(axes[1], 1.0, "1: the bound, an honest covariance")
    common.curves(axes[1], totals, "error_median", *shown, interval=("error_median", "error_q95"), **words)
    if len(claims):
        nees = axes[2]
        common.decades(nees, np.append(claims["nees_median"].clip(lower=0.5), 1.0), least=4.0)
        common.bound_line(nees, 1.0, "1: the bound, an honest covariance")
        limits = claims["nees_median_low"].min(), claims["nees_median_high"].max()
        nees.axhspan(*limits, color=BOUND_COLOR, alpha=0.15, linewidth=0, label="limits of an honest one, 95 %")
        words = {"heading": "squared error over claimed variance", "label": "NEES, median"}
        common.curves(nees, claims, "nees_median", *shown, **words)
    common.legend(fig, axes, view.look)
    over = "over error scales" if len(view.scales) > 1 else f"at error scale {plain(view.scales[0])}"
    last = common.at_scale(totals, view.scales[-1]).sort_values("success", ascending=False, kind="stable")
    ranked = [f"{e} {percent(v)}" for e, v in zip(last["estimator"], last["success"], strict=True)]
    most = f"What exceeds {CEILING['error_median']:g} bounds, or {CEILING['nees_median']:g} times the claimed variance"
    yield view.drawing(
        fig,
        "headline",
        f"Success, error and honesty {over}",
        "All trials of everybody. Left: share whose error lies inside the gate of the bound, with Clopper-Pearson 95 %"
        " intervals. Middle: median error over the bound at the truth, with a bar up to the 95 % quantile. Right:"
        " squared error over the variance that the estimator claims, 1 where it is honest.",
        f"{most}, stands at the top." if beyond else "",
        f"At scale {plain(view.scales[-1])} succeed: {common.enumerate_few(ranked, 20)}.",
    )


FIGURES = (Figure(draw, ("summary",), main=True),)
