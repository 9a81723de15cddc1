"""Whether estimators know how wrong they are: the calibration of NEES."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR
from ipe_bench.report.words import plain
from ipe_bench.statistics.summary import ALL

LINEAR = 0.1
"""Differences below this are drawn about in proportion, larger ones by their logarithm: honest curves differ by
hundredths, dishonest ones by up to 1."""


def draw(view: View) -> Iterator[Drawing]:
    """NEES of all estimators, a panel per error scale."""
    rows = view["calibration"]
    if rows.empty:
        return
    rows = rows[rows["parameter"] == ALL]
    look, top = view.with_look(rows["estimator"]), rows["error_scale"].max()
    fig, panels = common.panels_of_scales(rows, look)
    reach = 1.15 * max(LINEAR, float(rows[["difference", "low", "high"]].abs().max().max()))
    ticks: Sequence[float] = [t for t in (-1.0, -0.3, -0.1, -0.05, 0.0, 0.05, 0.1, 0.3, 1.0) if abs(t) <= reach]
    for ax, part in panels:
        ax.set_yscale("asinh", linear_width=LINEAR / 2)
        ax.set(xlim=(0, 1), ylim=(-reach, reach))
        ax.set_yticks(ticks, [common.number(t) for t in ticks])
        ax.set_yticks([], minor=True)
        _bands(ax, part)
        common.lines(ax, part, "at", "difference", look)
    common.axis_labels(fig, "nominal probability", "observed − nominal")
    common.legend(fig, fig.axes, look)
    each = view.totals.set_index(["error_scale", "estimator"])["calibration"]
    last = [f"{label}: {each[top, label]}" for label in look if (top, label) in each.index]
    yield view.drawing(
        fig,
        "calibration",
        "Calibration of NEES, converged trials",
        "NEES of the converged trials: the share of trials below each quantile of chi-square less its nominal"
        " probability. Grey: what chance explains (simultaneous bands, in which all parameters and NEES of an honest"
        " estimator stay in 95 % of cases; light where fewer trials converged). Below 0 in the middle: standard"
        f" deviations too small; above: too large. The vertical axis is logarithmic beyond ±{LINEAR / 2:g}.",
        f"At scale {plain(top)}, parameters included, {common.enumerate_few(last, 4)}.",
    )


def _bands(ax: Any, rows: pd.DataFrame) -> None:
    """The widest and the narrowest band of the panel's curves."""
    width = (rows["high"] - rows["low"]).groupby(rows["estimator"]).mean()
    for label, alpha in ((width.idxmax(), 0.12), (width.idxmin(), 0.15)):
        edge = rows[rows["estimator"] == label].drop_duplicates("at")
        ax.fill_between(edge["at"], edge["low"], edge["high"], color=BOUND_COLOR, alpha=alpha, linewidth=0, zorder=0)
    ax.axhline(0, color=BOUND_COLOR, linewidth=0.6, zorder=1)


FIGURES = (Figure(draw, ("summary", "calibration")),)
