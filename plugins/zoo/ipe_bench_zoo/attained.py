"""Tables and a data profile of who attains the known minima of Moré, Garbow and Hillstrom's
functions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.counted import cost
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.sections import Section
from ipe_bench.report.tables.table import Part, Table, column, words
from ipe_bench.report.words import enumerate_few, short, value_text
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.certified import certified_cells, certified_estimate
from ipe_bench.statistics.collect import Collection
from ipe_bench_zoo.mgh import Mgh, score

ATTAINED = (
    "function",
    "start",
    "estimator",
    "solved",
    "minimum",
    "sum_of_squares",
    "status",
    "cost",
    "gradients",
)
BUDGETS = (10, 100, 1000)
"""Simplex gradients, n + 1 simulations each, within which `attained_totals` counts problems."""


def attained_table(collection: Collection) -> pd.DataFrame:
    """A row per function, start and estimator: whether the estimate attains the least minimum (see
    `score`), else which other one, its sum of squares, its status and its cost; empty without such
    runs.

    Cost is in simulations, and in simplex gradients of n + 1 simulations, by which problems of
    different n are comparable (Moré and Wild, SIAM J. Optim. 20, 2009).
    """

    rows = []
    for group, cell, scenario in certified_cells(collection, Mgh.name):
        model = Mgh(scenario["function"], scenario["start"])
        columns, x = certified_estimate(collection, cell, model)
        reached = score(model, x)
        spent = float(
            cost(
                columns["simulations"],
                columns["jacobians"],
                cell.footer.get("jacobian_cost", model.n),
            )[0]
        )
        ended = reached.solved, reached.minimum, reached.sum_of_squares, str(columns["status"][0])
        rows.append(
            (model.function, model.start, group.estimator, *ended, spent, spent / (model.n + 1))
        )
    return pd.DataFrame(rows, columns=list(ATTAINED))


def attained_totals(table: pd.DataFrame) -> pd.DataFrame:
    """Per estimator: problems solved, in all and from each start; how many of them its status calls
    converged, and how many converged elsewhere; median cost of all problems, endless where
    unsolved; and solved within `BUDGETS`."""

    rows = []
    for estimator, part in table.groupby("estimator", sort=False):
        solved = part["solved"].astype(bool)
        converged = part["status"] == Status.CONVERGED.label
        spent = part["gradients"].where(solved, np.inf)
        rows.append(
            {"estimator": estimator, "problems": len(part), "solved": int(solved.sum())}
            | {
                f"solved_{start:g}": int(solved[part["start"] == start].sum())
                for start in sorted(set(table["start"]))
            }
            | {
                "converged": int((solved & converged).sum()),
                "elsewhere": int((~solved & converged).sum()),
            }
            | {"cost_median": float(part["cost"].where(solved, np.inf).median())}
            | {f"within_{budget}": int((spent <= budget).sum()) for budget in BUDGETS}
        )
    return pd.DataFrame(rows)


def data_profile(table: pd.DataFrame) -> pd.DataFrame:
    """The share of problems that each estimator solves within `at` simplex gradients, a step at
    each solution."""
    problems = table.groupby("estimator")["solved"].transform("size")
    solved = table.assign(problems=problems)[table["solved"].astype(bool)].sort_values(
        ["estimator", "gradients"]
    )
    share = (solved.groupby("estimator").cumcount() + 1) / solved["problems"]
    return solved.assign(at=solved["gradients"], share=share)[
        ["estimator", "at", "share"]
    ].reset_index(drop=True)


def attained_totals_table(totals: pd.DataFrame) -> Table:
    """How many problems of known minimum each estimator solves, the most first."""
    rows = totals.sort_values("solved", ascending=False, kind="stable", ignore_index=True)
    most = list(rows["solved"] == rows["solved"].max())
    starts = [str(name) for name in rows if str(name).startswith("solved_")]
    columns = [
        words("estimator", rows["estimator"], most),
        column("problems", rows["problems"], str),
        column("solved", rows["solved"], str, most),
        *(column(f"{name.removeprefix('solved_')} x", rows[name], str) for name in starts),
        column("converged", rows["converged"], str),
        column("elsewhere", rows["elsewhere"], str),
        column("median cost", rows["cost_median"], short),
        *(column(f"in {b}", rows[f"within_{b}"], str) for b in BUDGETS),
    ]
    caption = (
        "A problem is solved if the estimate attains its global minimum, f at most f* (1 + 1e-6) +"
        " 1e-12. 1 x and 10 x are multiples of the standard start. Converged counts solved"
        " problems whose status says so; elsewhere counts unsolved problems whose status says"
        " converged. Median cost counts simulations over all problems, a Jacobian as n, and is"
        " infinite for unsolved ones. In 10, 100, 1000 counts problems solved within that number"
        " of simplex gradients of n + 1 simulations."
    )
    return Table("attained", "Known minima", caption, columns, rows, whole="tables/attained.csv")


def _problems(minima: pd.DataFrame) -> Table:
    rows = minima.sort_values(["function", "start"], kind="stable", ignore_index=True)
    columns = [
        words("function", rows["function"]),
        column("start", rows["start"], value_text),
        words("estimator", rows["estimator"]),
        words("solved", rows["solved"].map({True: "yes", False: "no"})),
        words("minimum", ["-" if pd.isna(v) else f"{int(v) + 1}" for v in rows["minimum"]]),
        column("sum of squares", rows["sum_of_squares"], lambda v: f"{v:.6g}"),
        words("status", rows["status"]),
        column("cost", rows["cost"], short),
    ]
    caption = (
        "The number of the minimum whose sum of squares the estimate has, where 1 is the lowest;"
        " a dash means none."
    )
    return Table("attained_problems", "Known minima, problem by problem", caption, columns, rows)


def draw_known_minima(view: View) -> Iterator[Drawing]:
    """The share of problems that each estimator solves, against the cost."""
    table = attained_table(view.collection) if view.collection is not None else pd.DataFrame()
    if table.empty or (rows := data_profile(table)).empty:
        return
    problems = len(table[["function", "start"]].drop_duplicates())
    low, end = 0.9 * float(rows["at"].min()), 1.5 * float(rows["at"].max())
    # Each curve rises from none, and goes on to the end of the axis.
    final = rows.groupby("estimator", sort=False, as_index=False)["share"].max().assign(at=end)
    final = final.sort_values("share", ascending=False, kind="stable")
    best = list(final.loc[final["share"] == final["share"].max(), "estimator"])
    look = view.with_look(table["estimator"])
    rows = pd.concat([final.assign(share=0.0, at=low), rows, final], ignore_index=True)
    fig, (ax,) = common.panels(1, look, height=3.4)
    common.lines(ax, rows, "at", "share", look, drawstyle="steps-post")
    ax.set_xscale("log")
    ax.set_xlim(low, end)
    common.log_ticks(ax.xaxis, low, end)
    common.shares(ax)
    common.legend(fig, [ax], look)
    ax.set(xlabel="simplex gradients, n + 1 simulations each", ylabel="share of problems solved")
    yield view.drawing(
        fig,
        "data_profile",
        "Data profile on known minima",
        f"Share of {problems} problems of Moré, Garbow and Hillstrom solved within that cost (Moré"
        " and Wild).",
        f"Most, {round(final['share'].max() * problems)}, are solved by {enumerate_few(best, 3)}.",
    )


def write_known_minima(analysis: Analysis) -> Iterator[Part]:
    """Writes how many problems each estimator solves, and each problem."""
    if len(minima := attained_table(analysis.collection)):
        yield attained_totals_table(attained_totals(minima))
        yield _problems(minima)


SECTION = Section("Known minima", write_known_minima)
FIGURE = Figure(draw_known_minima, (), together=True, main=True)
