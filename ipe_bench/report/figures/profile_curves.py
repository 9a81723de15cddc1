"""Performance and data profiles over all scenarios."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.words import percent

PANELS = (
    ("performance", "performance profile", "cost over the cheapest estimator's"),
    ("data", "data profile", "simulations per trial"),
)


def draw(view: View) -> Iterator[Drawing]:
    profiles = view["profiles"]
    look = view.with_look(profiles["estimator"])
    if len(look) < 2:
        return
    fig, axes = common.panels(2, look, height=3.2)
    for (profile, title, heading), ax in zip(PANELS, axes, strict=True):
        rows = profiles[profiles["profile"] == profile]
        end = _end(rows)
        rows = rows[rows["at"] <= end]
        common.shares(ax, "")
        every = max(2, rows["at"].nunique() // 5)
        common.lines(ax, rows, "at", "share", look, every=every, drawstyle="steps-post")
        ax.set_xscale("log")
        # A little before 1, so that markers at 1 are whole.
        ax.set_xlim(0.93, end)
        common.log_ticks(ax.xaxis, 1.0, end)
        common.shares(ax, "share of trials with success")
        ax.set(title=title, xlabel=heading)
    common.legend_below(fig, axes, look)
    first = profiles[profiles["profile"] == "performance"].groupby("estimator", sort=False)["share"].first()
    final = profiles[profiles["profile"] == "data"].groupby("estimator", sort=False)["share"].last()
    caption = common.sentence(
        "All trials of all scenarios. Left (Dolan and Moré): share of trials in which an estimator succeeds at a cost"
        " of at most the abscissa times that of the cheapest success. Right (Moré and Wild): share in which it succeeds"
        " within that many simulations, a Jacobian counting as many as there are parameters.",
        f"{first.idxmax()} is the cheapest most often ({percent(first.max())}); {final.idxmax()} succeeds most often"
        f" ({percent(final.max())}).",
    )
    yield Drawing("profiles", "Performance and data profiles", caption, fig)


def _end(rows: pd.DataFrame) -> float:
    """A little behind the point from which on no curve rises."""
    top = rows.groupby("estimator")["share"].transform("max")
    arrived = rows[rows["share"] >= top].groupby("estimator")["at"].min()
    return max(1.5 * float(arrived.max()), 4.0)


FIGURE = Figure(draw, ("profiles",), together=True)
