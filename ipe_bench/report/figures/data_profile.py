"""Data profile: the share of problems of known minimum that each estimator solves within a cost."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.profiles import steps
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import looks
from ipe_bench.statistics.certified import data_profile


def draw(view: View) -> Iterator[Drawing]:
    table = view["attained"]
    profile = data_profile(table)
    if profile.empty:
        return
    problems = len(table[["function", "start"]].drop_duplicates())
    end = 1.5 * float(profile["at"].max())
    # Each curve goes on to the end of the axis.
    final = profile.groupby("estimator", sort=False, as_index=False)["share"].max().assign(at=end)
    best = final[final["share"] == final["share"].max()]
    labels = list(dict.fromkeys(table["estimator"]))
    look = looks(labels, chosen=list(final.sort_values("share", ascending=False, kind="stable")["estimator"][:10]))
    fig, (ax,) = common.panels(1, look, height=3.4)
    steps(ax, pd.concat([profile, final], ignore_index=True), look, 0.9 * float(profile["at"].min()), end)
    common.shares(ax, "share of problems solved")
    ax.set_xlabel("simplex gradients, n + 1 simulations each")
    common.legend(fig, [ax], look)
    caption = common.sentence(
        f"{problems} problems: functions of Moré, Garbow and Hillstrom from their starts. Solved: the sum of squares is"
        " the least known one. Data profile of Moré and Wild: the share solved within that cost, a Jacobian counting n"
        " simulations.",
        f"Most, {round(best['share'].max() * problems)}, are solved by"
        f" {common.enumerate_few(list(best['estimator']))}.",
    )
    yield Drawing("data_profile", "Data profile on known minima", caption, fig)


FIGURE = Figure(draw, ("attained",), together=True, main=True)
