"""How errors and NEES of trackers run from epoch to epoch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR
from ipe_bench.report.words import enumerate_few


def draw(view: View) -> Iterator[Drawing]:
    """Root mean square error of each state beside its bounds, and NEES within its limits."""
    rows = view["tracks"]
    if rows.empty:
        return
    look = view.with_look(rows["estimator"])
    states = list(dict.fromkeys(rows["parameter"]))[: common.MOST_PANELS - 1]
    fig, axes = common.panels(len(states) + 1, look)
    for state, ax in zip(states, axes, strict=False):
        part = rows[rows["parameter"] == state]
        common.lines(ax, part, "at", "rmse", look, legend=False)
        one = part[part["estimator"] == part["estimator"].iloc[0]]
        for name, dash, label in (
            ("bound", "--", "filter linearised at the truth"),
            ("posterior", ":", "posterior bound of filters"),
            ("posterior_smoothed", "-.", "posterior bound of smoothers"),
        ):
            if np.isfinite(one[name]).any():
                ax.plot(one["at"], one[name], dash, color=BOUND_COLOR, linewidth=1.0, label=label, zorder=1)
        common.decades(ax, part[["rmse", "bound", "posterior", "posterior_smoothed"]])
        common.title(ax, f"{state} [{one['unit'].iloc[0]}]" if one["unit"].iloc[0] else state)
    first, ax = rows[rows["parameter"] == states[0]], axes[-1]
    common.lines(ax, first, "at", "nees", look, legend=False)
    ax.axhspan(first["nees_low"].iloc[0], first["nees_high"].iloc[0], color=BOUND_COLOR, alpha=0.25, zorder=0)
    common.decades(ax, first["nees"])
    common.title(ax, "NEES / n")
    common.axis_labels(fig, "time [s]", "")
    common.legend(fig, axes, look)
    total = {name: np.sqrt(np.mean(part["rmse"] ** 2)) for name, part in first.groupby("estimator", sort=False)}
    yield view.drawing(
        fig,
        "tracks",
        "Tracks, converged trials",
        "Root mean square error over trials at each epoch, with that of the filter linearised at the truth, which a"
        " good filter attains, and the posterior Cramér-Rao bounds, which lie far below. NEES over n stays within the"
        " band at 95 % of single epochs if the covariance is right; neighbouring epochs are dependent.",
        f"{states[0]} over all epochs: {enumerate_few([f'{k} {v:.3g}' for k, v in total.items()], 20)}.",
    )


FIGURES = (Figure(draw, ("tracks",), main=True),)
