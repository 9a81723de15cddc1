"""Draws what accuracy costs: simulations against error, and iterations against the distance from
the limit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtri

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import GREY, MARKERS, Look
from ipe_bench.report.words import value_text
from ipe_bench.statistics.sample import CLOSE

LEAST_COST = 0.5
"""Position of an estimator without simulations: a logarithmic axis has no zero."""
_HIGHEST = 1e6
"""Errors beyond this many bounds stand at the upper edge."""
LEAST_DISTANCE = 1e-10
"""Distances from the limit below this are drawn here: round-off."""
MANY_ITERATIONS = 60
"""Iterations from which on the axis is logarithmic."""
_LOGARITHMIC = ", logarithmic from 10"


def draw_costs(view: View) -> Iterator[Drawing]:
    rows = view.totals[np.isfinite(view.totals["simulations_median"])]
    if rows.empty:
        return
    rows = _placed(rows, view)
    look = view.with_look(rows["estimator"])
    fig, panels = common.panels_of_scales(rows, look)
    efficient = view.reference if view.moving else "efficient estimator"
    for ax, here in panels:
        common.decades(ax, [*rows["error"], 1.0])
        _mark(ax, here, look)
        common.bound_line(ax, 1.0, efficient)
        ax.set_xscale("log")
        ax.set_xlim(rows["cost"].min() / 1.5, 1.5 * rows["cost"].max())
        common.log_ticks(ax.xaxis, *ax.get_xlim())
    over = view.reference.removeprefix("the ") if view.moving else "efficient one"
    common.axis_labels(fig, "simulations (median)", f"95 % error / {over}")
    common.legend(fig, fig.axes, look, points=True)
    yield view.drawing(
        fig,
        "cost_against_accuracy",
        "Cost against accuracy, all trials",
        "Lower left is better.",
        common.left_out(view.scales, panels),
    )


def _placed(rows: pd.DataFrame, view: View) -> pd.DataFrame:
    """Adds the place of each point: `cost`, `error`, and whether that is `over` the upper edge."""
    error = rows["error_q95"]
    if not view.moving:
        # The 95 % quantile of chi, over its root mean square; the errors of an epoch and of the
        # next are dependent.
        quantile = chdtri(view.n, 0.05)
        error = error / float(np.sqrt(quantile / view.n))
    cost = rows["simulations_median"].clip(lower=LEAST_COST)
    rows = rows.assign(cost=cost, error=error.clip(upper=_HIGHEST), over=error > _HIGHEST)
    # Points of about the same cost stand side by side, so that all are seen.
    span = cost.max() / cost.min()
    step = 0.04 * np.log(max(10.0, span))
    place = (np.log(cost) / step).round()
    beside = rows.groupby(["error_scale", place]).cumcount()
    rows["cost"] *= np.exp(step * beside)
    return rows


def _mark(ax: Any, rows: pd.DataFrame, look: Mapping[str, Look]) -> None:
    """Draws the points of a panel, and at its upper edge those beyond."""
    from matplotlib import rcParams

    size = (1.4 * rcParams["lines.markersize"]) ** 2
    style: Any = {"s": size, "edgecolor": "white", "linewidth": 0.6, "clip_on": False}
    for name, inside in rows[~rows["over"]].groupby("estimator", sort=False):
        one = look[str(name)]
        style |= {"marker": one.marker, "color": one.color}
        style["zorder"] = 2.5 if one.color == GREY else 3
        ax.scatter(inside["cost"], inside["error"], **style)
    for name, lost in rows[rows["over"]].groupby("estimator", sort=False):
        one = look[str(name)]
        common.beyond(ax, lost["cost"], lost["error"], one)


def draw_convergence(view: View) -> Iterator[Drawing]:
    """Draws how iterates approach their limit, a panel per estimator."""
    import seaborn as sns

    rows = view["convergence"]
    if rows.empty:
        return
    rows = rows[(rows["distance"] > 0) & np.isfinite(rows["distance"])]
    if rows.empty or not rows["iteration"].any():
        return
    # An estimate in one step has a start and an end alone.
    rows = rows[rows.groupby("estimator")["iteration"].transform("max") > 0]
    scales = sorted(set(rows["error_scale"]))
    names = {scale: f"error scale {value_text(scale)}" for scale in scales}
    distance = rows["distance"].clip(lower=LEAST_DISTANCE)
    rows = rows.assign(scale=rows["error_scale"].map(names), distance=distance)
    colors = sns.color_palette("crest", len(scales)).as_hex()
    by_scale: dict[str, Look] = {}
    for i, name in enumerate(names.values()):
        by_scale[name] = Look(colors[i], MARKERS[i % len(MARKERS)])
    look = view.with_look(rows["estimator"])
    # Those in colour come first.
    colored_first = sorted(look, key=lambda label: look[label].color == GREY)
    shown = colored_first[: common.most_panels()]
    fig, axes = common.panels(len(shown), by_scale)
    ends = (distance.min() / 3, distance.max() * 3)
    short = common.texts(shown, common.title_letters(axes[0]) - len(_LOGARITHMIC))
    for label, ax in zip(shown, axes, strict=True):
        _approach(ax, rows[rows["estimator"] == label], by_scale, short[label])
        ax.set_ylim(*ends)
        common.log_ticks(ax.yaxis, *ends)
    common.axis_labels(fig, "iteration", "distance to own limit [σ]")
    common.legend(fig, axes, by_scale)
    hidden = len(look) - len(shown)
    yield view.drawing(
        fig,
        "convergence",
        "Convergence, converged trials",
        "Median of the largest component of the distance to the last iterate.",
        f"{hidden} more are not shown." if hidden else "",
    )


def _approach(ax: Any, rows: pd.DataFrame, by_scale: Mapping[str, Look], label: str) -> None:
    """Draws one estimator's distances by iterations, a line per scale."""
    from matplotlib.ticker import MaxNLocator

    end = int(rows["iteration"].max())
    for scale, one in by_scale.items():
        own = rows[rows["scale"] == scale]
        ax.plot(own["iteration"], own["distance"], markevery=1 + end // 12, **one.line)
    ax.set_yscale("log")
    common.bound_line(ax, CLOSE, f"{CLOSE:g} standard deviations")
    ax.set_xlim(-0.03 * end - 0.2, 1.03 * end + 0.2)
    if end > MANY_ITERATIONS:
        ax.set_xscale("symlog", linthresh=10)
        common.title(ax, f"{label}{_LOGARITHMIC}")
    else:
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        common.title(ax, label)


FIGURES = (
    Figure(draw_costs, ("summary",), main=True),
    Figure(draw_convergence, ("convergence",)),
)
