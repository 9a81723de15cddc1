"""How iterates approach their limit, and how errors and NEES of trackers run from epoch to epoch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR, GREY, MARKERS, Look
from ipe_bench.report.words import enumerate_few, plain
from ipe_bench.statistics.histories import CLOSE

FLOOR = 1e-10
"""Distances below this are drawn here: round-off."""
LONG = 60
"""Iterations from which on the axis is logarithmic."""


def draw_convergence(view: View) -> Iterator[Drawing]:
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
    last = medians[medians["error_scale"] == scales[-1]]
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
        f" {enumerate_few(seen, 20)}.",
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


def draw_tracks(view: View) -> Iterator[Drawing]:
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


FIGURES = (Figure(draw_convergence, ("convergence",)), Figure(draw_tracks, ("tracks",), main=True))
