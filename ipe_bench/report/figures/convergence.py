"""How iterates approach their limit, at every error scale."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import GREY, MARKERS, Look
from ipe_bench.report.words import plain
from ipe_bench.statistics.histories import CLOSE

FLOOR = 1e-10
"""Distances below this are drawn here: round-off."""
LONG = 60
"""Iterations from which on the axis is logarithmic."""


def draw(view: View) -> Iterator[Drawing]:
    import seaborn as sns
    from matplotlib.ticker import MaxNLocator

    if view["convergence"].empty:
        return
    medians = median_distances(view["convergence"])
    # A filter's epochs are no iterations, and a direct estimate has a start and an end, and nothing between.
    iterating = [label for label, equation in view.equations.items() if equation is not None]
    longest = medians.groupby("estimator")["iteration"].transform("max")
    medians = medians[medians["estimator"].isin(iterating) & (longest > 0)]
    if medians.empty:
        return
    look = view.with_look(medians["estimator"])
    shown = sorted(look, key=lambda label: look[label].color == GREY)[: common.MOST_PANELS]
    scales = sorted(set(medians["error_scale"]))
    names = {scale: f"error scale {plain(scale)}" for scale in scales}
    colors = sns.color_palette("crest", len(scales)).as_hex()
    by_scale = {name: Look(colors[i], MARKERS[i % len(MARKERS)]) for i, name in enumerate(names.values())}
    medians = medians.assign(scale=medians["error_scale"].map(names))
    style = {**common.seaborn_style(by_scale, "scale"), "dashes": False, "estimator": None, "linewidth": 1.2}
    fig, axes = common.panels(len(shown), by_scale)
    bottom, top = medians["distance"].min() / 3, medians["distance"].max() * 3
    for label, ax in zip(shown, axes, strict=True):
        rows = medians[medians["estimator"] == label]
        end = int(rows["iteration"].max())
        sns.lineplot(rows, x="iteration", y="distance", ax=ax, markevery=1 + end // 12, **style)
        ax.set_yscale("log")
        ax.set_ylim(bottom, top)
        common.log_ticks(ax.yaxis, bottom, top)
        common.bound_line(ax, CLOSE, f"{CLOSE:g} standard deviations")
        ax.set_xlim(-0.03 * end - 0.2, 1.03 * end + 0.2)
        if end > LONG:
            ax.set_xscale("symlog", linthresh=10)
        else:
            ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        common.title(ax, f"{label}, logarithmic from 10" if end > LONG else label)
    common.axis_labels(fig, "iteration", "distance to own limit [σ]")
    common.legend(fig, axes, by_scale)
    last = common.at_scale(medians, scales[-1])
    arrived = last[last["distance"] > CLOSE].groupby("estimator", sort=False)["iteration"].max().add(1)
    seen = [f"{label} {arrived.get(label, 0):g}" for label in look if label in set(last["estimator"])]
    yield view.drawing(
        fig,
        "convergence",
        "Convergence, converged trials",
        "Median over the first converged trials of the largest component of the distance between an iterate and the"
        " last one, in standard deviations of the Cramér-Rao bound. The last iterate is not drawn, since its distance"
        " is zero by definition; a curve ends when half of the trials have ended.",
        f"Iterations until the median is within {CLOSE:g} standard deviations at scale {plain(scales[-1])}:"
        f" {common.enumerate_few(seen, 20)}.",
        f"{len(look) - len(shown)} further estimators are not shown." * (len(look) > len(shown)),
    )


def median_distances(frame: pd.DataFrame) -> pd.DataFrame:
    """Per error scale, estimator and iteration, the median distance of the trials from their last iterates, as long as
    less than half of them have come to their last one; those that have are nearer than any other."""
    found = []
    for key, part in frame.groupby(["error_scale", "estimator"]):
        part = part.assign(distance=part["distance"].where(np.isfinite(part["distance"]), np.inf))
        # Behind its last iterate, whose distance is zero, a trial stays there.
        table = part.pivot_table(index="iteration", columns="trial", values="distance").fillna(0.0)
        middle = np.sort(table, axis=1)[:, (table.shape[1] - 1) // 2]
        found += [(*key, k, max(d, FLOOR)) for k, d in zip(table.index, middle, strict=True) if 0 < d < np.inf]
    return pd.DataFrame(found, columns=["error_scale", "estimator", "iteration", "distance"])


FIGURES = (Figure(draw, ("convergence",)),)
