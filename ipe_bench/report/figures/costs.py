"""What accuracy costs: simulations against error, and data profiles of trials and of problems of known minimum."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.errors import MOST, quantiles
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import GREY, Look, looks
from ipe_bench.report.words import percent, plain
from ipe_bench.statistics.certified import data_profile

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

LEAST_COST = 0.5
"""What does not simulate at all stands here: a logarithmic axis has no zero."""
_HIGHEST = 1e6
"""Errors beyond this many bounds stand at the upper edge."""


def draw_costs(view: View) -> Iterator[Drawing]:
    import seaborn as sns

    rows = quantiles(view, MOST).merge(view["scores"][["error_scale", "estimator", "cost_median"]])
    rows = rows.assign(cost=rows["cost_median"].clip(lower=LEAST_COST), error=rows["error"].clip(upper=_HIGHEST))
    rows = rows[np.isfinite(rows["cost"])]
    if rows.empty:
        return
    look = view.with_look(rows["estimator"])
    fig, panels = common.panels_of_scales(rows, look)
    style = {**common.seaborn_style(look), "edgecolor": "white", "linewidth": 0.6, "zorder": 3}
    # Equal points lie upon each other: the later ones are smaller, so that all are seen.
    areas = np.linspace(90, 40, len(look)) / (1 if common.most_panels() > 4 else 2)
    sizes = {
        label: a if look[label].color != GREY else 20.0 for label, a in zip(style["hue_order"], areas, strict=True)
    }
    for ax, here in panels:
        common.decades(ax, [*rows["error"], 1.0])
        sns.scatterplot(here, x="cost", y="error", ax=ax, size="estimator", sizes=sizes, **style)
        common.bound_line(ax, 1.0, "Cramér-Rao bound")
        ax.set_xscale("log")
        ax.set_xlim(rows["cost"].min() / 1.5, rows["cost"].max() * 1.5)
        common.log_ticks(ax.xaxis, *ax.get_xlim())
    common.axis_labels(fig, "simulations per trial (median)", "95 % error / efficient estimator's")
    common.legend(fig, fig.axes, look)
    last = common.at_scale(rows, view.scales[-1])
    good = last[last["error"] <= last["error"].min() * 1.05].sort_values("cost_median", kind="stable").iloc[0]
    yield view.drawing(
        fig,
        "cost_against_accuracy",
        "Cost against accuracy, all trials",
        "Median cost of a trial in simulations, a Jacobian counting what it costs, against what 95 % of all trials err"
        " by at most, over the same of an efficient estimator; down and left is better.",
        f"Errors beyond {common.power_of_ten(_HIGHEST)} stand at the edge." * bool((rows["error"] == _HIGHEST).any()),
        f"The cheapest within 5 % of the least error at scale {plain(view.scales[-1])}: {good['estimator']}"
        f" ({good['cost_median']:g} simulations).",
    )


def draw_profiles(view: View) -> Iterator[Drawing]:
    rows = view["profiles"]
    rows = rows[rows["profile"] == "data"]
    if rows["estimator"].nunique() < 2:
        return
    final = rows.groupby("estimator", sort=False)["share"].max()
    # A little behind the point from which on no curve rises.
    end = max(
        1.5 * float(rows[rows["share"] >= rows["estimator"].map(final)].groupby("estimator")["at"].min().max()), 4.0
    )
    fig = _data_profile(rows[rows["at"] <= end], view.with_look(rows["estimator"]), 0.93, end)
    fig.axes[0].set(xlabel="simulations per trial", ylabel="share of trials with success")
    yield view.drawing(
        fig,
        "profiles",
        "Data profile, all trials",
        "All trials of all scenarios, pooled: the curves depend on which error scales there are. Data profile of Moré"
        " and Wild: the share of trials in which an estimator succeeds within that many simulations.",
        f"{final.idxmax()} succeeds most often ({percent(final.max())}).",
    )


def draw_known_minima(view: View) -> Iterator[Drawing]:
    table = view["attained"]
    rows = data_profile(table)
    if rows.empty:
        return
    problems = len(table[["function", "start"]].drop_duplicates())
    low, end = 0.9 * float(rows["at"].min()), 1.5 * float(rows["at"].max())
    # Each curve rises from none, and goes on to the end of the axis.
    final = rows.groupby("estimator", sort=False, as_index=False)["share"].max().assign(at=end)
    final = final.sort_values("share", ascending=False, kind="stable")
    best = list(final.loc[final["share"] == final["share"].max(), "estimator"])
    look = looks(list(dict.fromkeys(table["estimator"])), chosen=list(final["estimator"][:10]))
    rows = pd.concat([final.assign(share=0.0, at=low), rows, final], ignore_index=True)
    fig = _data_profile(rows, look, low, end)
    fig.axes[0].set(xlabel="simplex gradients, n + 1 simulations each", ylabel="share of problems solved")
    yield view.drawing(
        fig,
        "data_profile",
        "Data profile on known minima",
        f"{problems} problems: functions of Moré, Garbow and Hillstrom from their starts. Solved: the sum of squares is"
        " the least known one. Data profile of Moré and Wild: the share solved within that cost, a Jacobian counting n"
        " simulations.",
        f"Most, {round(final['share'].max() * problems)}, are solved by {common.enumerate_few(best)}.",
    )


def _data_profile(rows: pd.DataFrame, look: Mapping[str, Look], low: float, high: float) -> Canvas:
    fig, (ax,) = common.panels(1, look, height=3.4)
    common.steps(ax, rows, "at", "share", look, low, high)
    common.legend(fig, [ax], look)
    return fig


FIGURES = (
    Figure(draw_costs, ("summary", "distributions", "scores"), main=True),
    Figure(draw_known_minima, ("attained",), together=True, main=True),
    Figure(draw_profiles, ("profiles", "scores"), together=True),
)
