"""Performance and data profiles: over all scenarios, and over problems of known minimum."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import looks
from ipe_bench.report.words import percent
from ipe_bench.statistics.certified import data_profile


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
    caption = common.sentence(
        "All trials of all scenarios, pooled: the curves depend on which error scales there are. Left (Dolan and Moré):"
        " share of trials in which an estimator succeeds at a cost of at most the abscissa times that of the cheapest"
        " success. Right (Moré and Wild): share in which it succeeds within that many simulations.",
        f"{first.idxmax()} is the cheapest most often ({percent(first.max())}); {final.idxmax()} succeeds most often"
        f" ({percent(final.max())}).",
    )
    yield Drawing("profiles", "Performance and data profiles", caption, fig)


def draw_known_minima(view: View) -> Iterator[Drawing]:
    table = view["attained"]
    profile = data_profile(table)
    if profile.empty:
        return
    problems = len(table[["function", "start"]].drop_duplicates())
    end = 1.5 * float(profile["at"].max())
    # Each curve goes on to the end of the axis.
    final = profile.groupby("estimator", sort=False, as_index=False)["share"].max().assign(at=end)
    final = final.sort_values("share", ascending=False, kind="stable")
    best = list(final.loc[final["share"] == final["share"].max(), "estimator"])
    look = looks(list(dict.fromkeys(table["estimator"])), chosen=list(final["estimator"][:10]))
    fig, (ax,) = common.panels(1, look, height=3.4)
    low = 0.9 * float(profile["at"].min())
    common.steps(ax, pd.concat([profile, final], ignore_index=True), "at", "share", look, low, end)
    ax.set(xlabel="simplex gradients, n + 1 simulations each", ylabel="share of problems solved")
    common.legend(fig, [ax], look)
    caption = common.sentence(
        f"{problems} problems: functions of Moré, Garbow and Hillstrom from their starts. Solved: the sum of squares is"
        " the least known one. Data profile of Moré and Wild: the share solved within that cost, a Jacobian counting n"
        " simulations.",
        f"Most, {round(final['share'].max() * problems)}, are solved by {common.enumerate_few(best)}.",
    )
    yield Drawing("data_profile", "Data profile on known minima", caption, fig)


FIGURES = (
    Figure(draw_known_minima, ("attained",), together=True, main=True),
    Figure(draw_profiles, ("profiles", "scores"), together=True),
)
