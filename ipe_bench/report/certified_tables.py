"""Tables of runs on certified readings; such runs have one trial and no error scale, so figures leave them out."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pandas as pd

from ipe_bench.report.table import Column, Table, column, words
from ipe_bench.report.words import plain, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.attained import BUDGETS, attained_table, attained_totals
from ipe_bench.statistics.collect import Collection
from ipe_bench.statistics.digits import certified_averages, certified_table


def certified_tables(collection: Collection) -> tuple[list[Table], pd.DataFrame]:
    """Digits per data set and their averages, as tables and as the averages alone; empty where no run had certified
    readings."""
    table = certified_table(collection)
    averages = certified_averages(table)
    if table.empty:
        return [], averages
    shown = [
        Table("certified", "Certified readings", _DIGITS, _columns(table), table.round(2)),
        Table("certified_averages", "Certified readings, averages", _AVERAGES, _columns(averages), averages.round(2)),
    ]
    return shown, averages


_DIGITS = (
    "Log relative error against the certified answer, at most 11: the fewest over a data set's parameters, over their"
    " standard deviations, and of the residual sum of squares."
)
_AVERAGES = _DIGITS + " Averaged over the data sets; solved: four digits or more of every parameter."
_TITLES = {
    "dataset": "data set",
    "lre_parameters": "digits",
    "lre_deviations": "of deviations",
    "lre_rss": "of residuals",
    "datasets": "data sets",
    "deviations_to_6_digits": "deviations to 6 digits",
    "mean_lre_parameters": "digits",
    "mean_lre_deviations": "of deviations",
    "mean_lre_rss": "of residuals",
}


def attained_tables(collection: Collection) -> tuple[list[Table], pd.DataFrame]:
    """Who attains known minima, in all and problem by problem, as tables and as the totals alone; empty where no run
    had such problems."""
    table = attained_table(collection)
    totals = attained_totals(table)
    if table.empty:
        return [], totals
    problems = table.sort_values(["function", "start"], kind="stable", ignore_index=True)
    minima = ["-" if v is None or pd.isna(v) else f"{int(v) + 1}" for v in problems["minimum"]]
    shown = [
        words("function", problems["function"]),
        column("start", problems["start"], plain),
        words("estimator", problems["estimator"]),
        words("solved", ["yes" if v else "no" for v in problems["solved"]]),
        words("minimum", minima),
        column("sum of squares", problems["sum_of_squares"], lambda v: f"{v:.6g}"),
        words("status", problems["status"]),
        column("cost", problems["cost"], short),
    ]
    return [
        Table("attained", "Known minima", _ATTAINED, attained_columns(totals), totals),
        Table("attained_problems", "Known minima, problem by problem", _PROBLEMS, shown, problems),
    ], totals


def attained_columns(totals: pd.DataFrame) -> list[Column]:
    """The columns of the totals as they are shown."""
    most = totals["solved"] == totals["solved"].max()
    columns = [words("estimator", totals["estimator"], list(most)), column("problems", totals["problems"], str)]
    columns.append(column("solved", totals["solved"], str, list(most)))
    starts = [name for name in totals if str(name).startswith("solved_")]
    columns += [column(f"{str(name).removeprefix('solved_')} x", totals[name], str) for name in starts]
    columns.append(column("converged", totals["converged"], str))
    columns.append(column("elsewhere", totals["elsewhere"], str))
    columns.append(column("median cost", totals["cost_median"], short))
    return [*columns, *(column(f"in {b}", totals[f"within_{b}"], str) for b in BUDGETS)]


_ATTAINED = (
    "Problems whose least minimum the estimate attains: f at most f* (1 + 1e-6) + 1e-12. 1 x, 10 x: from these"
    " multiples of the standard start. Converged: solved, and the status says so. Elsewhere: unsolved, and the status"
    " says converged. Median cost: simulations over all problems, a Jacobian counting n, infinite where unsolved."
    " In 10, 100, 1000: solved within so many simplex gradients of n + 1 simulations."
)
_PROBLEMS = (
    "Which of a function's known minima has the estimate's sum of squares, the lowest being 1; a dash: none of them."
)


def _columns(table: pd.DataFrame) -> list[Column]:
    """Texts as they are, counts in full, digits to two places."""
    columns = []
    for name in table.columns:
        title, values = _TITLES.get(name, name), table[name]
        if pd.api.types.is_float_dtype(values):
            columns.append(column(title, values, lambda v: f"{v:.2f}"))
        elif pd.api.types.is_integer_dtype(values):
            columns.append(column(title, values, str))
        else:
            columns.append(words(title, values))
    return columns


def without_certified(analysis: Analysis) -> Analysis:
    """The analysis of the simulated trials alone."""
    groups = tuple(g for g in analysis.collection.groups if g.columns["noise"] != "certified")
    if len(groups) == len(analysis.collection.groups):
        return analysis
    held = {f.name: getattr(analysis, f.name) for f in fields(analysis)}
    tables: dict[str, Any] = {
        name: table[table["noise"] != "certified"]
        for name, table in held.items()
        if isinstance(table, pd.DataFrame) and "noise" in table
    }
    return replace(analysis, collection=replace(analysis.collection, groups=groups), **tables)
