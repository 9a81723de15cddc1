"""The tables of certified readings and of published errors."""

from __future__ import annotations

import pandas as pd

from ipe_bench.report.tables.table import Column, Table, column, counts_of, texts_of, words
from ipe_bench.statistics.certified import certified_averages, certified_table, published_table
from ipe_bench.statistics.collect import Collection


def certified_tables(collection: Collection) -> list[Table]:
    """Returns digits per data set with averages, and published errors, if there are data; a
    terminal shows those that name the file with the `whole`."""
    digits = certified_table(collection)
    found = [] if digits.empty else _digits(digits)
    published = published_table(collection)
    if len(published):
        found.append(_published(published, collection))
    return found


def _digits(digits: pd.DataFrame) -> list[Table]:
    """Returns the mean digits of an estimator from each start, the most first, and its digits per
    data set."""
    caption = (
        "Log relative error against the certified answer, at most 11. It is the smallest over the"
        " parameters of a data set, the smallest over their standard deviations, and the error of"
        " the residual sum of squares."
    )
    columns = [words("data set", digits["dataset"])]
    columns += counts_of(digits, "start")
    columns += texts_of(digits, "estimator")
    columns += _lre(digits, "")
    columns += texts_of(digits, "status")
    each = Table("certified", "Certified readings", caption, columns, digits.round(2))
    rows = certified_averages(digits).sort_values(["mean_lre_parameters", "start"], ascending=False)
    columns = texts_of(rows, "estimator")
    columns += counts_of(rows, "start")
    columns.append(column("data sets", rows["datasets"], str))
    columns += counts_of(rows, "solved")
    columns += _lre(rows, "mean_")
    columns.append(column("deviations to 6 digits", rows["deviations_to_6_digits"], str))
    caption += " Averaged over the data sets; solved: four digits or more of every parameter."
    title = "Certified readings, averages"
    whole = "tables/certified_averages.csv"
    return [Table("certified_averages", title, caption, columns, rows.round(2), whole=whole), each]


def _published(rows: pd.DataFrame, collection: Collection) -> Table:
    columns = texts_of(rows, "model", "state", "estimator")
    columns += [column(name, rows[name], "{:.12f}".format) for name in ("published", "found")]
    columns.append(column("difference", rows["difference"], "{:.1e}".format))
    scenarios = [group.footer["identity"]["scenario"] for group in collection.groups]
    models = [scenario.get("model", {}) for scenario in scenarios]
    sources = dict.fromkeys(model["source"] for model in models if "source" in model)
    caption = (
        "Root mean square errors over all time steps of one stored path, beside those that are"
        f" published. {' '.join(sources)}"
    )
    title = "Published errors of trackers"
    return Table("published", title, caption, columns, rows, whole="tables/published.csv")


_LRE = {
    "parameters": "digits of parameters",
    "deviations": "of deviations",
    "rss": "of residuals",
}


def _lre(rows: pd.DataFrame, prefix: str) -> list[Column]:
    shown = "{:.2f}".format
    return [column(title, rows[f"{prefix}lre_{name}"], shown) for name, title in _LRE.items()]
