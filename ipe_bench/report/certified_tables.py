"""Tables of runs on certified readings; such runs have one trial and no error scale, so figures leave them out."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pandas as pd

from ipe_bench.report.tables import Column, Table, column, words
from ipe_bench.statistics.analysis import Analysis
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
