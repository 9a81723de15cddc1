"""Digits that agree with certified answers, from what is stored of runs on certified readings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.measurements.nist import Nist, score
from ipe_bench.statistics.collect import Collection, StoredCell

COLUMNS = ("dataset", "start", "estimator", "lre_parameters", "lre_deviations", "lre_rss", "status")


def certified_table(collection: Collection) -> pd.DataFrame:
    """A row per data set, start and estimator with its correct digits (see `nist.score`); empty without such runs."""
    rows = []
    for group in collection.groups:
        for estimates, truth in group.cells:
            model = _model(estimates)
            if model is not None and truth is not None:
                rows.append({"estimator": group.estimator} | _row(collection, estimates, model))
    return pd.DataFrame(rows, columns=list(COLUMNS)).sort_values(["estimator", "start", "dataset"], ignore_index=True)


def certified_averages(table: pd.DataFrame) -> pd.DataFrame:
    """Per estimator and start: the mean digits, and how many data sets have four digits or more."""
    rows = [
        {
            "estimator": estimator,
            "start": start,
            "datasets": len(part),
            "solved": int((part["lre_parameters"] >= 4).sum()),
            "deviations_to_6_digits": int((part["lre_deviations"] >= 6).sum()),
            "mean_lre_parameters": part["lre_parameters"].mean(),
            "mean_lre_deviations": part["lre_deviations"].mean(),
            "mean_lre_rss": part["lre_rss"].mean(),
        }
        for (estimator, start), part in table.groupby(["estimator", "start"], sort=False)
    ]
    return pd.DataFrame(rows)


def _model(cell: StoredCell) -> Nist | None:
    """The data set of a cell on certified readings, from its name and start; nothing stored is constructed."""
    scenario = cell.footer["identity"]["scenario"]
    if cell.footer["names"]["noise"] != "certified" or cell.footer["names"]["measurement"] != Nist.name:
        return None
    return Nist(scenario["measurement"]["dataset"], scenario["measurement"]["start"])


def _row(collection: Collection, cell: StoredCell, model: Nist) -> dict[str, Any]:
    names = [p.name for p in model.parameters]
    columns = collection.load(cell, None)
    # What is stored is the error against the certified answer, which stands for the truth.
    x = model.recorded.x + np.array([columns[f"error_{name}"][0] for name in names])
    deviation = np.array([columns[f"deviation_{name}"][0] for name in names])
    reached = score(model, x, deviation)
    return {
        "dataset": model.dataset,
        "start": model.start,
        "lre_parameters": reached.parameters,
        "lre_deviations": reached.deviations,
        "lre_rss": reached.residual_sum_of_squares,
        "status": str(columns["status"][0]),
    }
