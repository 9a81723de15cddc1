"""Tables of runs on certified readings; such runs have one trial and no error scale, so figures leave them out."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pandas as pd

from ipe_bench.basics.files import write_atomically
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.collect import Collection
from ipe_bench.statistics.digits import certified_averages, certified_table


def write_certified(collection: Collection, folder: Path) -> tuple[tuple[Path, ...], pd.DataFrame]:
    """Writes certified.csv and certified_averages.csv; returns their paths and the averages, empty where no run had
    certified readings."""
    table = certified_table(collection)
    averages = certified_averages(table)
    if table.empty:
        return (), averages
    paths = []
    for name, data in (("certified", table), ("certified_averages", averages)):
        path = folder / f"{name}.csv"
        content = data.to_csv(index=False, float_format="%.2f")
        write_atomically(path, lambda temporary, content=content: temporary.write_text(content, encoding="utf-8"))
        paths.append(path)
    return tuple(paths), averages


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
