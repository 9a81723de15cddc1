"""Deadlines over the error scale, and how far each is above the median."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View


def draw(view: View) -> Iterator[Drawing]:
    if "deadline" not in view.totals:
        return  # summarised where the statistic was not there
    medians = view["scores"][["error_scale", "estimator", "cost_median"]]
    rows = view.totals.merge(medians, on=["error_scale", "estimator"])
    rows = rows[np.isfinite(rows["deadline"]) & (rows["deadline"] > 0)]
    if rows.empty:
        return
    # An end that is not known is not drawn; neither is one of a trial that cost nothing.
    known = np.isfinite(rows["deadline_high"]) & (rows["deadline_low"] > 0)
    low, high = rows["deadline_low"].where(known), rows["deadline_high"].where(known)
    rows = rows.assign(
        low=low, high=high, tail=rows["deadline"] / rows["cost_median"].clip(lower=1)
    )
    look = view.with_look(rows["estimator"])
    fig, (by, tail) = common.panels(2, look, height=3.0, scales=view.scales)
    common.decades(by, np.concatenate([rows["deadline"], high, low]))
    words = {"heading": "99 % of trials are done by", "label": "simulations"}
    common.curves(by, rows, "deadline", look, view.scales, interval=("low", "high"), **words)
    common.decades(tail, np.append(rows["tail"], 1.0))
    common.curves(tail, rows, "tail", look, view.scales, heading="over the median", label="ratio")
    common.bound_line(tail, 1.0, "every trial alike")
    common.legend(fig, [by, tail], look)
    last = rows[rows["error_scale"] == view.scales[-1]].sort_values("deadline", kind="stable")
    told = ", ".join(f"{e} {v:.3g}" for e, v in last[["estimator", "deadline"]].to_numpy()[:3])
    yield view.drawing(
        fig,
        "deadline",
        "How long the slowest trials take",
        "The cost by which 99 % of trials are done, with its 95 % interval, and over the median.",
        f"At the largest scale: {told}.",
    )


FIGURE = Figure(draw, ("summary", "scores"))
