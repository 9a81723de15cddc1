"""The headline in one figure: who succeeds, how far off everybody is, and who knows it, over all trials."""

from __future__ import annotations

from collections.abc import Iterator

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
    success, error = axes[:2]
    common.shares(success, "")
    common.curves(success, totals, "success", view.look, view.scales, interval=("success_low", "success_high"))
    common.shares(success, "share of all trials")
    common.title(success, "success")
    common.decades(error, totals[["error_median", "error_q95"]].clip(lower=0.5), least=4.0)
    common.bound_line(error, 1.0, "1: the bound, an honest covariance")
    common.curves(error, totals, "error_median", view.look, view.scales, interval=("error_median", "error_q95"))
    common.title(error, "error over the bound")
    error.set_ylabel("median, bar to 95 %")
    if len(claims):
        _consistency(axes[2], claims, view)
    common.legend(fig, axes, view.look)
    yield Drawing(f"headline{view.suffix}", _title(view), _caption(view, totals, beyond), fig)


def _consistency(ax: common.Axes, claims: pd.DataFrame, view: View) -> None:
    common.decades(ax, np.append(claims["nees_median"].clip(lower=0.5), 1.0), least=4.0)
    common.bound_line(ax, 1.0, "1: the bound, an honest covariance")
    low, high = claims["nees_median_low"].min(), claims["nees_median_high"].max()
    ax.axhspan(low, high, color=BOUND_COLOR, alpha=0.15, linewidth=0, label="limits of an honest one, 95 %")
    common.curves(ax, claims, "nees_median", view.look, view.scales)
    common.title(ax, "squared error over claimed variance")
    ax.set_ylabel("NEES, median")


def _title(view: View) -> str:
    over = "over error scales" if len(view.scales) > 1 else f"at error scale {plain(view.scales[0])}"
    return f"Success, error and honesty {over}"


def _caption(view: View, totals: pd.DataFrame, beyond: bool) -> str:
    last = common.at_scale(totals, view.scales[-1]).sort_values("success", ascending=False, kind="stable")
    ranked = [f"{e} {percent(v)}" for e, v in zip(last["estimator"], last["success"], strict=True)]
    most = f"What exceeds {CEILING['error_median']:g} bounds, or {CEILING['nees_median']:g} times the claimed variance"
    return common.sentence(
        "All trials of everybody. Left: share whose error lies inside the gate of the bound, with Clopper-Pearson 95 %"
        " intervals. Middle: median error over the bound at the truth, with a bar up to the 95 % quantile. Right:"
        " squared error over the variance that the estimator claims, 1 where it is honest.",
        f"{most}, stands at the top." if beyond else "",
        f"At scale {plain(view.scales[-1])} succeed: {common.enumerate_few(ranked, 20)}. {view.label}.",
    )


FIGURES = (Figure(draw, ("summary",), main=True),)
