"""Digits of NIST's certified answers, and attained minima of Moré, Garbow and Hillstrom's functions, from what is
stored."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import mgh, nist
from ipe_bench.measurements.counted import cost

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.basics.linalg import Array
    from ipe_bench.statistics.collect import Collection, Group, StoredCell

DIGITS = ("dataset", "start", "estimator", "lre_parameters", "lre_deviations", "lre_rss", "status")
ATTAINED = ("function", "start", "estimator", "solved", "minimum", "sum_of_squares", "status", "cost", "gradients")
BUDGETS = (10, 100, 1000)
"""Simplex gradients, n + 1 simulations each, within which `attained_totals` counts problems."""


def certified_table(collection: Collection) -> pd.DataFrame:
    """A row per data set, start and estimator with its correct digits (see `nist.score`); empty without such runs."""
    import pandas as pd

    rows = []
    for group, cell, scenario in _certified(collection, nist.Nist.name):
        model = nist.Nist(scenario["dataset"], scenario["start"])
        columns, x = _estimate(collection, cell, model)
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


def attained_table(collection: Collection) -> pd.DataFrame:
    """A row per function, start and estimator: whether the estimate attains the least minimum (see `mgh.score`), else
    which other one, its sum of squares, its status and its cost; empty without such runs.

    Cost is in simulations, and in simplex gradients of n + 1 simulations, by which problems of different n are
    comparable (Moré and Wild, SIAM J. Optim. 20, 2009).
    """
    import pandas as pd

    rows = []
    for group, cell, scenario in _certified(collection, mgh.Mgh.name):
        model = mgh.Mgh(scenario["function"], scenario["start"])
        columns, x = _estimate(collection, cell, model)
        reached = mgh.score(model, x)
        spent = float(cost(columns["simulations"], columns["jacobians"], cell.footer.get("jacobian_cost", model.n))[0])
        ended = reached.solved, reached.minimum, reached.sum_of_squares, str(columns["status"][0])
        rows.append((model.function, model.start, group.estimator, *ended, spent, spent / (model.n + 1)))
    return pd.DataFrame(rows, columns=list(ATTAINED))


def attained_totals(table: pd.DataFrame) -> pd.DataFrame:
    """Per estimator: problems solved, in all and from each start; how many of them its status calls converged, and how
    many converged elsewhere; median cost of all problems, endless where unsolved; and solved within `BUDGETS`."""
    import pandas as pd

    rows = []
    for estimator, part in table.groupby("estimator", sort=False):
        solved = part["solved"].astype(bool)
        converged = part["status"] == Status.CONVERGED.label
        spent = part["gradients"].where(solved, np.inf)
        rows.append(
            {"estimator": estimator, "problems": len(part), "solved": int(solved.sum())}
            | {f"solved_{start:g}": int(solved[part["start"] == start].sum()) for start in sorted(set(table["start"]))}
            | {"converged": int((solved & converged).sum()), "elsewhere": int((~solved & converged).sum())}
            | {"cost_median": float(part["cost"].where(solved, np.inf).median())}
            | {f"within_{budget}": int((spent <= budget).sum()) for budget in BUDGETS}
        )
    return pd.DataFrame(rows)


def data_profile(table: pd.DataFrame) -> pd.DataFrame:
    """The share of problems that each estimator solves within `at` simplex gradients, a step at each solution."""
    problems = table.groupby("estimator")["solved"].transform("size")
    solved = table.assign(problems=problems)[table["solved"].astype(bool)].sort_values(["estimator", "gradients"])
    share = (solved.groupby("estimator").cumcount() + 1) / solved["problems"]
    return solved.assign(at=solved["gradients"], share=share)[["estimator", "at", "share"]].reset_index(drop=True)


def _certified(collection: Collection, measurement: str) -> Iterator[tuple[Group, StoredCell, dict[str, Any]]]:
    """The results on a measurement's certified readings, with what the measurement was described by."""
    for group in collection.groups:
        for cell in group.cells:
            names = cell.footer["names"]
            if names["noise"] == "certified" and names["measurement"] == measurement:
                yield group, cell, cell.footer["identity"]["scenario"]["measurement"]


def _estimate(collection: Collection, cell: StoredCell, model: Any) -> tuple[dict[str, Array], Array]:
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
