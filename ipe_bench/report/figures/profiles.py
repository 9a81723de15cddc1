"""Performance and data profiles over all scenarios."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.words import percent

PANELS = (
    ("performance", "performance profile", "cost over the cheapest's"),
    ("data", "data profile", "simulations per trial"),
)


def draw(view: View) -> Iterator[Drawing]:
    profiles = view["profiles"]
    if len(set(profiles["estimator"])) < 2:
        return
    look = view.with_look(profiles["estimator"])
    pooled = f"{len(view.scales)} error scales pooled" if len(view.scales) > 1 else "all trials"
    fig, axes = common.panels(2, look, height=3.2)
    for (profile, title, heading), ax in zip(PANELS, axes, strict=True):
        rows = profiles[profiles["profile"] == profile]
        top = rows.groupby("estimator")["share"].transform("max")
        # A little behind the point from which on no curve rises.
        end = max(1.5 * float(rows[rows["share"] >= top].groupby("estimator")["at"].min().max()), 4.0)
        steps(ax, rows[rows["at"] <= end], look, 0.93, end)
        common.shares(ax, "")
        common.title(ax, f"{title}, {pooled}")
        ax.set_xlabel(heading)
    fig.supylabel("share of trials with success", fontsize="medium")
    common.legend(fig, axes, look)
    first = profiles[profiles["profile"] == "performance"].groupby("estimator", sort=False)["share"].first()
    final = profiles[profiles["profile"] == "data"].groupby("estimator", sort=False)["share"].last()
    caption = common.sentence(
        "All trials of all scenarios, pooled: the curves depend on which error scales there are. Left (Dolan and Moré):"
        " share of trials in which an estimator succeeds at a cost of at most the abscissa times that of the cheapest"
        " success. Right (Moré and Wild): share in which it succeeds within that many simulations.",
        f"{first.idxmax()} is the cheapest most often ({percent(first.max())}); {final.idxmax()} succeeds most often"
        f" ({percent(final.max())}).",
    )
    yield Drawing("profiles", "Performance and data profiles", caption, fig)


def steps(ax: Any, rows: pd.DataFrame, look: Any, low: float, high: float) -> None:
    """Steps from `low` to `high` on a logarithmic axis of costs."""
    common.lines(ax, rows, "at", "share", look, drawstyle="steps-post")
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    common.log_ticks(ax.xaxis, low, high)


FIGURE = Figure(draw, ("profiles", "scores"), together=True)
