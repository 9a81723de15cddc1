"""Tables of runs on certified readings and on problems of known minimum, which have one trial and no error scale."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pandas as pd

from ipe_bench.report.table import Column, Table, column, words
from ipe_bench.report.words import plain, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.certified import (
    BUDGETS,
    attained_table,
    attained_totals,
    certified_averages,
    certified_table,
)
from ipe_bench.statistics.collect import Collection


def certified_tables(collection: Collection) -> list[Table]:
    """Digits per data set and their averages, who attains known minima in all and problem by problem; those tables
    that there are data for. What a terminal shows of them is what names the file that holds the whole."""
    digits, minima = certified_table(collection), attained_table(collection)
    found = [] if digits.empty else _digits(digits)
    return found if minima.empty else [*found, attained_totals_table(attained_totals(minima)), _problems(minima)]


def _digits(digits: pd.DataFrame) -> list[Table]:
    """The mean digits of an estimator from each start, the most first, and its digits per data set."""
    caption = (
        "Log relative error against the certified answer, at most 11: the fewest over a data set's parameters, over"
        " their standard deviations, and of the residual sum of squares."
    )
    columns = [
        words("data set", digits["dataset"]),
        column("start", digits["start"], str),
        words("estimator", digits["estimator"]),
        *_lre(digits, ""),
        words("status", digits["status"]),
    ]
    each = Table("certified", "Certified readings", caption, columns, digits.round(2))
    rows = certified_averages(digits).sort_values(["mean_lre_parameters", "start"], ascending=False)
    columns = [
        words("estimator", rows["estimator"]),
        column("start", rows["start"], str),
        column("data sets", rows["datasets"], str),
        column("solved", rows["solved"], str),
        *_lre(rows, "mean_"),
        column("deviations to 6 digits", rows["deviations_to_6_digits"], str),
    ]
    caption += " Averaged over the data sets; solved: four digits or more of every parameter."
    title, whole = "Certified readings, averages", "tables/certified_averages.csv"
    return [Table("certified_averages", title, caption, columns, rows.round(2), whole=whole), each]


def _lre(rows: pd.DataFrame, prefix: str) -> list[Column]:
    titles = {"parameters": "digits", "deviations": "of deviations", "rss": "of residuals"}
    return [column(title, rows[f"{prefix}lre_{name}"], lambda v: f"{v:.2f}") for name, title in titles.items()]


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
        "Problems whose least minimum the estimate attains: f at most f* (1 + 1e-6) + 1e-12. 1 x, 10 x: from these"
        " multiples of the standard start. Converged: solved, and the status says so. Elsewhere: unsolved, and the"
        " status says converged. Median cost: simulations over all problems, a Jacobian counting n, infinite where"
        " unsolved. In 10, 100, 1000: solved within so many simplex gradients of n + 1 simulations."
    )
    return Table("attained", "Known minima", caption, columns, rows, whole="tables/attained.csv")


def _problems(minima: pd.DataFrame) -> Table:
    rows = minima.sort_values(["function", "start"], kind="stable", ignore_index=True)
    columns = [
        words("function", rows["function"]),
        column("start", rows["start"], plain),
        words("estimator", rows["estimator"]),
        words("solved", rows["solved"].map({True: "yes", False: "no"})),
        words("minimum", ["-" if pd.isna(v) else f"{int(v) + 1}" for v in rows["minimum"]]),
        column("sum of squares", rows["sum_of_squares"], lambda v: f"{v:.6g}"),
        words("status", rows["status"]),
        column("cost", rows["cost"], short),
    ]
    caption = (
        "Which of a function's minima has the estimate's sum of squares, the lowest being 1; a dash: none of them."
    )
    return Table("attained_problems", "Known minima, problem by problem", caption, columns, rows)


def without_certified(analysis: Analysis) -> Analysis:
    """The analysis of the simulated trials alone."""
    groups = tuple(g for g in analysis.collection.groups if g.columns["noise"] != "certified")
    if len(groups) == len(analysis.collection.groups):
        return analysis
    held: dict[str, Any] = {f.name: getattr(analysis, f.name) for f in fields(analysis)}
    held = {k: v[v["noise"] != "certified"] for k, v in held.items() if isinstance(v, pd.DataFrame) and "noise" in v}
    if not groups:
        held["profiles"] = analysis.profiles.iloc[:0]
    return replace(analysis, **held | {"collection": replace(analysis.collection, groups=groups)})
