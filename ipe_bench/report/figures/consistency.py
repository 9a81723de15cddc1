"""Whether estimators know how wrong they are: NEES, coverage and the filters' NIS, and curves of calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR
from ipe_bench.report.words import plain
from ipe_bench.statistics.summary import ALL

NIS = "extra_nis"
LINEAR = 0.1
"""Differences below this are drawn about in proportion, larger ones by their logarithm: honest curves differ by
hundredths, dishonest ones by up to 1."""


def draw(view: View) -> Iterator[Drawing]:
    totals = view.totals[view.totals["nees_median"].notna()]
    if not totals.empty:
        yield _consistency(view, totals)
    rows = view["calibration"]
    if not rows.empty:
        yield _calibration(view, rows[rows["parameter"] == ALL])


def _consistency(view: View, totals: pd.DataFrame) -> Drawing:
    # The median lies within its limits where this interval holds 1.
    middle = totals["nees_median"]
    totals = totals.assign(low=middle / totals["nees_median_high"], high=middle / totals["nees_median_low"])
    scores = view["scores"]
    scores = scores[scores[NIS].notna()] if NIS in scores.columns else scores.iloc[:0]
    look = view.with_look(totals["estimator"])
    fig, axes = common.panels(3 if len(scores) else 2, look, height=3.0)
    nees, coverage = axes[:2]
    common.decades(nees, np.append(totals["nees_median"], 1.0))
    common.curves(nees, totals, "nees_median", look, view.scales, interval=("low", "high"))
    nees.set_ylabel("median NEES")
    common.shares(coverage, "")
    common.curves(coverage, totals, "coverage95", look, view.scales)
    common.shares(coverage, "share of trials")
    common.title(nees, "squared error over claimed variance")
    common.title(coverage, "truth inside the 95 % ellipsoid")
    if len(scores):
        counted = scores.merge(totals[["error_scale", "estimator", "trials"]], on=["error_scale", "estimator"])
        common.decades(axes[2], np.append(counted[NIS], 1.0))
        common.curves(axes[2], counted, NIS, look, view.scales)
        axes[2].set_ylabel("mean NIS")
        common.title(axes[2], "filters' innovations (NIS)")
    for ax, honest in zip(axes, (1.0, 0.95, 1.0), strict=False):
        common.bound_line(ax, honest, "honest covariance")
    common.legend(fig, axes, look)
    inside = (totals["low"] <= 1) & (totals["high"] >= 1)
    always = [e for e in look if inside[totals["estimator"] == e].all()]
    caption = common.sentence(
        "All trials. First panel: median normalised estimation error squared over that of chi-square, 1 where the"
        " reported covariance is right; a bar that does not reach 1 is outside its 95 % limits. Second panel: how often"
        " the truth lies inside the estimator's own 95 % ellipsoid.",
        "Third panel: the filters' innovations against the covariance that they expect of them." if len(scores) else "",
        f"Inside the limits at every scale: {common.enumerate_few(always, 20) or 'no estimator'}. {view.label}.",
    )
    return Drawing(f"consistency{view.suffix}", "Consistency of the reported covariance, all trials", caption, fig)


def _calibration(view: View, rows: pd.DataFrame) -> Drawing:
    """NEES of all estimators, a panel per error scale."""
    look = view.with_look(rows["estimator"])
    scales = common.spread(sorted(set(rows["error_scale"])))
    fig, axes = common.panels(len(scales), look)
    for scale, ax in zip(scales, axes, strict=True):
        part = common.at_scale(rows, scale)
        _axes(ax, part, rows)
        common.lines(ax, part, "at", "difference", look)
        common.title(ax, f"error scale {plain(scale)}")
    common.axis_labels(fig, "nominal probability", "observed − nominal")
    common.legend(fig, axes, look)
    each = view["summary"][view["summary"]["parameter"] == ALL].set_index(["error_scale", "estimator"])["calibration"]
    last = [f"{label}: {each[scales[-1], label]}" for label in look if (scales[-1], label) in each.index]
    caption = common.sentence(
        "NEES of the converged trials: the share of trials below each quantile of chi-square less its nominal"
        " probability. Grey: what chance explains (simultaneous bands, in which all parameters and NEES of an honest"
        " estimator stay in 95 % of cases; light where fewer trials converged). Below 0 in the middle: standard"
        f" deviations too small; above: too large. The vertical axis is logarithmic beyond ±{LINEAR / 2:g}.",
        f"At scale {plain(scales[-1])}, parameters included, {common.enumerate_few(last, 4)}. {view.label}.",
    )
    return Drawing(f"calibration{view.suffix}", "Calibration of NEES, converged trials", caption, fig)


def _axes(ax: Any, rows: pd.DataFrame, everywhere: pd.DataFrame) -> None:
    """A panel with the widest and the narrowest band of its curves, with the axis of all panels."""
    ax.set_yscale("asinh", linear_width=LINEAR / 2)
    reach = max(LINEAR, float(everywhere[["difference", "low", "high"]].abs().max().max()))
    ticks: Sequence[float] = [t for t in (-1, -0.3, -0.1, -0.05, 0, 0.05, 0.1, 0.3, 1) if abs(t) <= 1.15 * reach]
    ax.set_ylim(-1.15 * reach, 1.15 * reach)
    ax.set_yticks(ticks, [plain(float(t)).replace("-", "\N{MINUS SIGN}") for t in ticks])
    ax.set_yticks([], minor=True)
    ax.set_xlim(0, 1)
    width = (rows["high"] - rows["low"]).groupby(rows["estimator"]).mean()
    for label, alpha in ((width.idxmax(), 0.12), (width.idxmin(), 0.15)):
        edge = rows[rows["estimator"] == label].drop_duplicates("at")
        ax.fill_between(edge["at"], edge["low"], edge["high"], color=BOUND_COLOR, alpha=alpha, linewidth=0, zorder=0)
    ax.axhline(0, color=BOUND_COLOR, linewidth=0.6, zorder=1)


FIGURE = Figure(draw, ("calibration", "summary", "scores"))
