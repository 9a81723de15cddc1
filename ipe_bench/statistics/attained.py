"""Which estimator attains known minima, and at what cost, from what is stored of runs on Moré, Garbow and Hillstrom's
functions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.counted import cost
from ipe_bench.measurements.mgh import Mgh, score
from ipe_bench.statistics.collect import Collection, Group, StoredCell

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("function", "start", "estimator", "solved", "minimum", "sum_of_squares", "status", "cost", "gradients")
BUDGETS = (10, 100, 1000)
"""Simplex gradients, n + 1 simulations each, within which `attained_totals` counts problems."""


def attained_table(collection: Collection) -> pd.DataFrame:
    """A row per function, start and estimator: whether the estimate attains the least minimum (see `mgh.score`), else
    which other one, its sum of squares, its status and its cost; empty without such runs.

    Cost is in simulations, and in simplex gradients of n + 1 simulations, by which problems of different n are
    comparable (Moré and Wild, SIAM J. Optim. 20, 2009).
    """
    import pandas as pd

    rows = []
    for group in collection.groups:
        for estimates, _ in group.cells:
            model = _model(estimates)
            if model is not None:
                rows.append(_row(collection, group, estimates, model))
    return pd.DataFrame(rows, columns=list(COLUMNS))


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
    import pandas as pd

    parts = []
    for estimator, part in table.groupby("estimator", sort=False):
        spent = np.sort(part.loc[part["solved"].astype(bool), "gradients"].to_numpy(dtype=float))
        share = np.arange(1, len(spent) + 1) / len(part)
        parts.append(pd.DataFrame({"estimator": estimator, "at": spent, "share": share}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=["estimator", "at", "share"])


def _model(cell: StoredCell) -> Mgh | None:
    """The problem of a cell, from its name and start; nothing stored is constructed."""
    if cell.footer["names"]["noise"] != "certified" or cell.footer["names"]["measurement"] != Mgh.name:
        return None
    stored = cell.footer["identity"]["scenario"]["measurement"]
    return Mgh(stored["function"], stored["start"])


def _row(collection: Collection, group: Group, cell: StoredCell, model: Mgh) -> dict[str, Any]:
    columns = collection.load(cell, None)
    # What is stored is the error against the least minimum, which stands for the truth.
    x = model.recorded.x + np.array([columns[f"error_{p.name}"][0] for p in model.parameters])
    attained = score(model, x)
    spent = cost(columns["simulations"], columns["jacobians"], cell.footer.get("jacobian_cost", model.n))[0]
    return {
        "function": model.function,
        "start": model.start,
        "estimator": group.estimator,
        "solved": attained.solved,
        "minimum": attained.minimum,
        "sum_of_squares": attained.sum_of_squares,
        "status": str(columns["status"][0]),
        "cost": float(spent),
        "gradients": float(spent) / (model.n + 1),
    }
