"""Whether estimators know how wrong they are: NEES against its limits, coverage, and the filters' NIS."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View

NIS = "extra_nis"


def draw(view: View) -> Iterator[Drawing]:
    totals = view.totals
    # The mean lies within its limits where this interval holds 1.
    totals = totals.assign(low=totals["nees"] / totals["nees_high"], high=totals["nees"] / totals["nees_low"])
    totals = totals[totals["nees"].notna()]
    scores = view["scores"]
    scores = scores[scores[NIS].notna()] if NIS in scores.columns else scores.iloc[:0]
    if totals.empty:
        return
    look = view.with_look(totals["estimator"])
    fig, axes = common.panels(3 if len(scores) else 2, look, height=3.0)
    nees, coverage = axes[:2]
    common.decades(nees, np.append(totals["nees"], 1.0))
    common.curves(nees, totals, "nees", look, view.scales, interval=("low", "high"))
    nees.set(title="NEES over n, solved trials", ylabel="mean NEES / n")
    common.shares(coverage, "")
    common.curves(coverage, totals, "coverage95", look, view.scales, trials="trials")
    common.shares(coverage, "share of all trials")
    coverage.set_title("truth inside the 95 % ellipsoid")
    if len(scores):
        counted = scores.merge(totals[["error_scale", "estimator", "trials"]], on=["error_scale", "estimator"])
        common.decades(axes[2], np.append(counted[NIS], 1.0))
        common.curves(axes[2], counted, NIS, look, view.scales, trials="trials")
        axes[2].set(title="NIS over readings, all trials", ylabel="mean NIS")
    for ax, honest in zip(axes, (1.0, 0.95, 1.0), strict=False):
        common.bound_line(ax, honest, "honest covariance")
    common.legend_below(fig, axes, look)
    inside = (totals["low"] <= 1) & (totals["high"] >= 1)
    always = [e for e in look if inside[totals["estimator"] == e].all()]
    caption = common.sentence(
        "First panel: mean normalised estimation error squared over the number of parameters, 1 where the reported"
        " covariance is right; a bar that does not reach 1 is outside the chi-square limits of 95 %. Second panel: how"
        " often the truth lies inside the estimator's own 95 % ellipsoid.",
        "Third panel: the filters' innovations against the covariance that they expect of them." if len(scores) else "",
        common.UPON,
        f"Inside the limits at every scale: {common.enumerate_few(always, 20) or 'nobody'}. {view.label}.",
    )
    yield Drawing(f"consistency{view.suffix}", "Consistency of the reported covariance", caption, fig)


FIGURE = Figure(draw, ("summary", "scores"))
