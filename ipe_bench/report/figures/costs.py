"""Draws what accuracy costs: simulations against error, and iterations against the distance from the limit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.special import chdtri

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import GREY, MARKERS, Look
from ipe_bench.report.words import enumerate_few, short, value_text
from ipe_bench.statistics.sample import CLOSE

LEAST_COST = 0.5
"""Position of an estimator without simulations: a logarithmic axis has no zero."""
_HIGHEST = 1e6
"""Errors beyond this many bounds stand at the upper edge."""
LEAST_DISTANCE = 1e-10
"""Distances from the limit below this are drawn here: round-off."""
MANY_ITERATIONS = 60
"""Iterations from which on the axis is logarithmic."""


def draw_costs(view: View) -> Iterator[Drawing]:
    from matplotlib import rcParams

    rows = view.totals[np.isfinite(view.totals["simulations_median"])]
    if rows.empty:
        return
    # The 95 % quantile of chi, over its root mean square; the errors of an epoch and of the next are dependent.
    efficient = 1.0 if view.moving else float(np.sqrt(chdtri(view.n, 0.05) / view.n))
    error = rows["error_q95"] / efficient
    shown = {
        "cost": rows["simulations_median"].clip(lower=LEAST_COST),
        "error": error.clip(upper=_HIGHEST),
    }
    rows, look = rows.assign(**shown, over=error > _HIGHEST), view.with_look(rows["estimator"])
    # Points of about the same cost stand side by side, so that all are seen.
    step = 0.04 * np.log(max(10.0, rows["cost"].max() / rows["cost"].min()))
    place = (np.log(rows["cost"]) / step).round()
    rows["cost"] *= np.exp(step * rows.groupby(["error_scale", place]).cumcount())
    fig, panels = common.panels_of_scales(rows, look)
    size = (1.4 * rcParams["lines.markersize"]) ** 2
    style: Any = {"s": size, "edgecolor": "white", "linewidth": 0.6, "clip_on": False}
    for ax, here in panels:
        common.decades(ax, [*rows["error"], 1.0])
        for name, inside in here[~here["over"]].groupby("estimator", sort=False):
            one = look[str(name)]
            layer = 2.5 if one.color == GREY else 3
            ax.scatter(
                inside["cost"],
                inside["error"],
                marker=one.marker,
                color=one.color,
                zorder=layer,
                **style,
            )
        for name, lost in here[here["over"]].groupby("estimator", sort=False):
            common.beyond(ax, lost["cost"], lost["error"], look[str(name)])
        common.bound_line(ax, 1.0, view.reference if view.moving else "efficient estimator")
        ax.set_xscale("log")
        ax.set_xlim(rows["cost"].min() / 1.5, rows["cost"].max() * 1.5)
        common.log_ticks(ax.xaxis, *ax.get_xlim())
    over = view.reference.removeprefix("the ") if view.moving else "efficient one"
    common.axis_labels(fig, "simulations (median)", f"95 % error / {over}")
    common.legend(fig, fig.axes, look, points=True)
    last = rows[rows["error_scale"] == view.scales[-1]]
    good = (
        last[last["error"] <= last["error"].min() * 1.05]
        .sort_values("simulations_median", kind="stable")
        .iloc[0]
    )
    yield view.drawing(
        fig,
        "cost_against_accuracy",
        "Cost against accuracy, all trials",
        "Down and left is better; equal costs stand side by side.",
        common.left_out(view.scales, panels),
        f"Cheapest within 5 % of the least error at scale {value_text(view.scales[-1])}: {good['estimator']},"
        f" {short(good['simulations_median'])} simulations.",
    )


def draw_convergence(view: View) -> Iterator[Drawing]:
    """Draws how iterates approach their limit, a panel per estimator."""
    import seaborn as sns
    from matplotlib.ticker import MaxNLocator

    rows = view["convergence"]
    rows = rows[(rows["distance"] > 0) & np.isfinite(rows["distance"])] if len(rows) else rows
    if rows.empty or not rows["iteration"].any():
        return
    # An estimate in one step has a start and an end alone.
    rows = rows[rows.groupby("estimator")["iteration"].transform("max") > 0]
    look, scales = view.with_look(rows["estimator"]), sorted(set(rows["error_scale"]))
    shown = sorted(look, key=lambda label: look[label].color == GREY)[: common.most_panels()]
    names = {scale: f"error scale {value_text(scale)}" for scale in scales}
    colors = sns.color_palette("crest", len(scales)).as_hex()
    by_scale = {
        name: Look(colors[i], MARKERS[i % len(MARKERS)]) for i, name in enumerate(names.values())
    }
    rows = rows.assign(
        scale=rows["error_scale"].map(names), distance=rows["distance"].clip(lower=LEAST_DISTANCE)
    )
    style = {
        **common.seaborn_style(by_scale, "scale"),
        "dashes": False,
        "estimator": None,
        "linewidth": 1.2,
    }
    fig, axes = common.panels(len(shown), by_scale)
    bottom, top = rows["distance"].min() / 3, rows["distance"].max() * 3
    for label, ax in zip(shown, axes, strict=True):
        part = rows[rows["estimator"] == label]
        end = int(part["iteration"].max())
        sns.lineplot(part, x="iteration", y="distance", ax=ax, markevery=1 + end // 12, **style)
        ax.set_yscale("log")
        ax.set_ylim(bottom, top)
        common.log_ticks(ax.yaxis, bottom, top)
        common.bound_line(ax, CLOSE, f"{CLOSE:g} standard deviations")
        ax.set_xlim(-0.03 * end - 0.2, 1.03 * end + 0.2)
        if end > MANY_ITERATIONS:
            ax.set_xscale("symlog", linthresh=10)
        else:
            ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        common.title(ax, f"{label}, logarithmic from 10" if end > MANY_ITERATIONS else label)
    common.axis_labels(fig, "iteration", "distance to own limit [σ]")
    common.legend(fig, axes, by_scale)
    last = rows[rows["error_scale"] == scales[-1]]
    arrived = (
        last[last["distance"] > CLOSE].groupby("estimator", sort=False)["iteration"].max().add(1)
    )
    seen = [
        f"{label} {arrived.get(label, 0):g}" for label in look if label in set(last["estimator"])
    ]
    yield view.drawing(
        fig,
        "convergence",
        "Convergence, converged trials",
        "Median of the largest component of the distance to the last iterate.",
        f"Iterations to {CLOSE:g} σ at scale {value_text(scales[-1])}: {enumerate_few(seen, 2)}.",
        f"{len(look) - len(shown)} more are not shown." * (len(look) > len(shown)),
    )


FIGURES = (
    Figure(draw_costs, ("summary",), main=True),
    Figure(draw_convergence, ("convergence",)),
)
