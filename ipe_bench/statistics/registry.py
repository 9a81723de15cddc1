"""The statistics that are computed, ours and those of plugins, and the rows of the summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from ipe_bench.basics.errors import UserError, place_of
from ipe_bench.statistics.records import MAIN, MAIN_OF_STATES, NOT_MAIN, SCORES, STATISTICS
from ipe_bench.statistics.sample import Sample
from ipe_bench.statistics.statistic import (
    ALL,
    BEST,
    Condition,
    Kind,
    Statistic,
    Where,
    frame_columns,
    rows_of,
)

if TYPE_CHECKING:
    import pandas as pd

_RESERVED = (
    *(BEST, "measurement", "noise", "prior", "error_scale", "seed", "estimator"),
    *("parameter", "unit", "scenario"),
)
DIGITS = 4
"""Significant digits of the statistics in `summary.csv`."""
_of_plugins: dict[str, Statistic] = {}


def all_statistics() -> tuple[Statistic, ...]:
    """Returns the records of the summary: ours, and those that were added."""
    return (*STATISTICS, *_of_plugins.values())


def add_statistics(records: Sequence[Statistic]) -> list[str]:
    """Registers these statistics beside ours, in place of those that were added before.

    Returns a line for each that cannot be.
    """
    _of_plugins.clear()
    faults = []
    for record in records:
        fault = fault_of(record)
        if fault:
            name = getattr(record, "name", record)
            faults.append(f"statistic={name}: {fault}; it is left out")
        else:
            _of_plugins[record.name] = record
    return faults


def fault_of(record: Any) -> str:
    """Returns the fault that keeps a record from being added to ours and the others; empty if there
    is none."""
    if not isinstance(record, Statistic):
        return f"is a {type(record).__name__} and not a Statistic"
    others = [other for other in _of_plugins.values() if other is not record]
    taken = {*_RESERVED, *frame_columns([*STATISTICS, *SCORES, *others])}
    for column in record.columns:
        if not (column.isidentifier() and column.isascii()):
            return f"{column!r} is not a name for a column; use letters, digits and underscores"
        if column in taken:
            return f"there is a column {column} already; choose another name"
    places = [("where", where, Where) for where in record.where]
    chosen = [("kind", record.kind, Kind), *places, ("given", record.given, Condition)]
    for name, value, choices in chosen:
        if value not in get_args(choices):
            return f"{name}={value}: choose from {', '.join(get_args(choices))}"
    return ""


def columns_of_added(record: Statistic, sample: Sample) -> dict[str, list[Any]]:
    """Computes the columns of a record that a plugin adds.

    Raises:
        UserError: it raises, or gives something else than a value per parameter and one over all.
    """
    try:
        columns = record.columns_of(sample)
    except Exception as error:
        raise UserError(place_of(error)) from error
    kind = str if record.kind == "word" else int | float | np.number
    for name, values in columns.items():
        if len(values) != sample.n + 1:
            raise UserError(
                f"{name}: has {len(values)} values; return one, or one for each of {sample.n}"
                " parameters and for all"
            )
        for value in values:
            if not isinstance(value, kind):
                raise UserError(
                    f"{name}: a value is a {type(value).__name__}; return a float, or NaN for none"
                )
    return columns


def summary_columns() -> tuple[str, ...]:
    """Returns the columns of `summary_all.csv` behind those that say what a row is of."""
    return (*frame_columns(all_statistics()), BEST)


def main_columns(summary: pd.DataFrame) -> pd.DataFrame:
    """Selects the columns of `summary.csv`: what a row is of, and the main statistics and those of
    plugins, rounded.

    `summary_all.csv` has all digits: trials that could tell more than four apart are hardly ever
    run.
    """
    states = "noise" in summary and (summary["noise"] == "model").any()
    names = MAIN_OF_STATES if states else MAIN
    statistics = [*(s for s in STATISTICS if s.name in names), *_of_plugins.values()]
    chosen = {*frame_columns(statistics), BEST} - {*NOT_MAIN}
    heads = [c for c in summary.columns if c not in summary_columns()]
    shown = chosen.union(heads)
    main = summary[[c for c in summary.columns if c in shown]].copy()
    numbers = main.drop(columns=heads).select_dtypes("float")
    main[numbers.columns] = numbers.map(lambda number: float(f"{number:.{DIGITS}g}"))
    return main


def summary_rows(sample: Sample) -> list[dict[str, Any]]:
    """Computes a row per parameter and one over all, without the comparison of the estimator with
    its rivals.

    A statistic that was added and raises, or gives what cannot be shown, is missing in these rows,
    and named in the collection's problems.
    """
    rows = rows_of(STATISTICS, sample)
    for record in _of_plugins.values():
        try:
            columns = columns_of_added(record, sample)
        except UserError as error:
            line = f"statistic={record.name}: {error}; it is missing where that is so"
            sample.collection.extra_problems.append(line)
            nothing = "-" if record.kind == "word" else np.nan
            columns = {name: [nothing] * len(rows) for name in record.columns}
        for name, values in columns.items():
            for row, value in zip(rows, values, strict=True):
                row[name] = value
    group = sample.group
    head = {**group.columns, "estimator": group.estimator, **group.options}
    names = [*sample.names, ALL]
    units = [*(p["unit"] for p in sample.parameters), "linear bound"]
    return [
        {**head, "parameter": name, "unit": unit, **row}
        for name, unit, row in zip(names, units, rows, strict=True)
    ]


def to_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Converts rows to a table, columns in the order that readers know."""
    import pandas as pd

    frame = pd.DataFrame(list(rows))
    known = summary_columns()
    if frame.empty:
        heads = ["measurement", "noise", "error_scale", "estimator", "parameter", "unit"]
        return pd.DataFrame(columns=[*heads, *known])
    keys = [c for c in frame.columns if c not in (*known, "parameter", "unit")]
    first = [c for c in ("measurement", "noise") if c in keys]
    last = ["error_scale", "estimator"]
    options = [c for c in keys if c.startswith("estimator.")]
    elsewhere = (*first, *last, *options)
    middle = [c for c in keys if c not in elsewhere]
    return frame[[*first, *middle, *last, *options, "parameter", "unit", *known]]
