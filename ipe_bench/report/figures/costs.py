"""What accuracy costs: simulations against error, performance and data profiles, and problems of known minimum."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.errors import MOST, quantiles
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import GREY, looks
from ipe_bench.report.words import percent, plain
from ipe_bench.statistics.certified import data_profile

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
    profiles = view["profiles"]
    if profiles["estimator"].nunique() < 2:
        return
    look = view.with_look(profiles["estimator"])
    pooled = f"{len(view.scales)} error scales pooled" if len(view.scales) > 1 else "all trials"
    fig, axes = common.panels(2, look, height=3.2)
    headings = {"performance": "cost over the cheapest's", "data": "simulations per trial"}
    for (profile, heading), ax in zip(headings.items(), axes, strict=True):
        rows = profiles[profiles["profile"] == profile]
        top = rows.groupby("estimator")["share"].transform("max")
        # A little behind the point from which on no curve rises.
        end = max(1.5 * float(rows[rows["share"] >= top].groupby("estimator")["at"].min().max()), 4.0)
        common.steps(ax, rows[rows["at"] <= end], "at", "share", look, 0.93, end)
        common.title(ax, f"{profile} profile, {pooled}")
        ax.set_xlabel(heading)
    fig.supylabel("share of trials with success", fontsize="medium")
    common.legend(fig, axes, look)
    first = profiles[profiles["profile"] == "performance"].groupby("estimator", sort=False)["share"].first()
    final = profiles[profiles["profile"] == "data"].groupby("estimator", sort=False)["share"].last()
    yield view.drawing(
        fig,
        "profiles",
        "Performance and data profiles",
        "All trials of all scenarios, pooled: the curves depend on which error scales there are. Left (Dolan and Moré):"
        " share of trials in which an estimator succeeds at a cost of at most the abscissa times that of the cheapest"
        " success. Right (Moré and Wild): share in which it succeeds within that many simulations.",
        f"{first.idxmax()} is the cheapest most often ({percent(first.max())}); {final.idxmax()} succeeds most often"
        f" ({percent(final.max())}).",
    )


def draw_known_minima(view: View) -> Iterator[Drawing]:
    table = view["attained"]
    profile = data_profile(table)
    if profile.empty:
        return
    problems = len(table[["function", "start"]].drop_duplicates())
    end = 1.5 * float(profile["at"].max())
    # Each curve rises from none, and goes on to the end of the axis.
    final = profile.groupby("estimator", sort=False, as_index=False)["share"].max().assign(at=end)
    final = final.sort_values("share", ascending=False, kind="stable")
    best = list(final.loc[final["share"] == final["share"].max(), "estimator"])
    look = looks(list(dict.fromkeys(table["estimator"])), chosen=list(final["estimator"][:10]))
    fig, (ax,) = common.panels(1, look, height=3.4)
    low = 0.9 * float(profile["at"].min())
    rows = pd.concat([final.assign(share=0.0, at=low), profile, final], ignore_index=True)
    common.steps(ax, rows, "at", "share", look, low, end)
    ax.set(xlabel="simplex gradients, n + 1 simulations each", ylabel="share of problems solved")
    common.legend(fig, [ax], look)
    yield view.drawing(
        fig,
        "data_profile",
        "Data profile on known minima",
        f"{problems} problems: functions of Moré, Garbow and Hillstrom from their starts. Solved: the sum of squares is"
        " the least known one. Data profile of Moré and Wild: the share solved within that cost, a Jacobian counting n"
        " simulations.",
        f"Most, {round(final['share'].max() * problems)}, are solved by {common.enumerate_few(best)}.",
    )


FIGURES = (
    Figure(draw_costs, ("summary", "distributions", "scores"), main=True),
    Figure(draw_known_minima, ("attained",), together=True, main=True),
    Figure(draw_profiles, ("profiles", "scores"), together=True),
)
