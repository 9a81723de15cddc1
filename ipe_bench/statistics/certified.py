"""Digits of certified answers and published errors, from what is stored."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.measurements import nist

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.basics.linalg import Array
    from ipe_bench.statistics.collect import Collection, Group, StoredCell

DIGITS = ("dataset", "start", "estimator", "lre_parameters", "lre_deviations", "lre_rss", "status")


def certified_table(collection: Collection) -> pd.DataFrame:
    """A row per data set, start and estimator with its correct digits (see `nist.score`); empty without such runs."""
    import pandas as pd

    rows = []
    for group, cell, scenario in certified_cells(collection, nist.Nist.name):
        model = nist.Nist(scenario["dataset"], scenario["start"])
        columns, x = certified_estimate(collection, cell, model)
        deviation = np.array([columns[f"deviation_{p.name}"][0] for p in model.parameters])
        reached = nist.score(model, x, deviation)
        digits = reached.parameters, reached.deviations, reached.residual_sum_of_squares
        rows.append((model.dataset, model.start, group.estimator, *digits, str(columns["status"][0])))
    return pd.DataFrame(rows, columns=list(DIGITS)).sort_values(["estimator", "start", "dataset"], ignore_index=True)


def certified_averages(table: pd.DataFrame) -> pd.DataFrame:
    """Per estimator and start: the mean digits, and how many data sets have four digits or more."""
    import pandas as pd

    if table.empty:
        return pd.DataFrame()
    enough = table.assign(solved=table["lre_parameters"] >= 4, deviations_to_6_digits=table["lre_deviations"] >= 6)
    groups = enough.groupby(["estimator", "start"], sort=False)
    counts = groups[["solved", "deviations_to_6_digits"]].sum()
    means = groups[["lre_parameters", "lre_deviations", "lre_rss"]].mean().add_prefix("mean_")
    return pd.concat([groups.size().rename("datasets"), counts, means], axis=1).reset_index()


def certified_cells(collection: Collection, measurement: str) -> Iterator[tuple[Group, StoredCell, dict[str, Any]]]:
    """The results on a measurement's certified readings, with what the measurement was described by."""
    for group in collection.groups:
        for cell in group.cells:
            names = cell.footer["names"]
            if names["noise"] == "certified" and names["measurement"] == measurement:
                yield group, cell, cell.footer["identity"]["scenario"]["measurement"]


def certified_estimate(collection: Collection, cell: StoredCell, model: Any) -> tuple[dict[str, Array], Array]:
    """The one row of a result, and its estimate: what is stored is the error against the certified answer."""
    columns = collection.load(cell, None)
    return columns, model.recorded.x + np.array([columns[f"error_{p.name}"][0] for p in model.parameters])


def published_table(collection: Collection) -> pd.DataFrame:
    """A row per state and tracker of stored paths: the published root mean square error, and the one found."""
    import pandas as pd

    rows = []
    for group in collection.groups:
        model = group.footer["identity"]["scenario"].get("model", {})
        for state, published in model.get("published", {}).items():
            if (known := published.get(group.label)) is not None:
                (found,) = collection.load(group.cells[0], [f"path_{state}"])[f"path_{state}"]
                rows.append((group.columns["measurement"], state, group.estimator, known, found, found - known))
    return pd.DataFrame(rows, columns=["model", "state", "estimator", "published", "found", "difference"])
