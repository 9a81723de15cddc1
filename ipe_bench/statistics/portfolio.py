"""What the best choice among the compared estimators would come to: trial by trial, and with one choice for all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.comparisons import Outcomes, common
from ipe_bench.statistics.consistency import clopper_pearson
from ipe_bench.statistics.intervals import quantile

AUTO = "auto"
"""The estimator that stands beside the best choices, where it is among those compared."""


def portfolio_row(outcomes: Mapping[str, Outcomes]) -> dict[str, Any]:
    """The virtual best and the single best estimator on the trials that all have; nothing with fewer than two.

    The virtual best (Xu, Hutter, Hoos, Leyton-Brown, J. Artif. Intell. Res. 32, 2008) is an oracle that takes the
    cheapest estimator that succeeds in each trial, and succeeds where any does. The single best succeeds most often,
    and of several that do at the least median cost. Cost is in simulations, endless without success.
    """
    paired = common(outcomes)
    if len(paired) < 2:
        return {}
    costs = {label: np.where(o.success, o.cost, np.inf) for label, o in paired.items()}
    virtual = np.min(list(costs.values()), axis=0)
    if not len(virtual):
        return {}
    single = min(costs, key=lambda label: (-_share(costs[label]), quantile(costs[label], 0.5)))
    low, high = clopper_pearson(int(np.isfinite(virtual).sum()), len(virtual))
    row = {"trials": len(virtual), "virtual_success": _share(virtual), "virtual_low": low, "virtual_high": high}
    row |= {"virtual_cost": quantile(virtual, 0.5), "single": single}
    for name, label in (("single", single), (AUTO, AUTO)):
        known = label in costs
        row[f"{name}_success"] = _share(costs[label]) if known else np.nan
        row[f"{name}_cost"] = quantile(costs[label], 0.5) if known else np.nan
    return row


def pooled(scenarios: Sequence[Mapping[str, Outcomes]], labels: Sequence[str]) -> dict[str, Outcomes]:
    """The outcomes of these estimators over all scenarios, as if they were one; trials are numbered anew."""
    paired = [common({label: outcomes[label] for label in labels}) for outcomes in scenarios]
    return {label: _joined([p[label] for p in paired]) for label in labels}


def _joined(parts: Sequence[Outcomes]) -> Outcomes:
    distance, success, cost = (
        np.concatenate([getattr(p, name) for p in parts]) for name in ("distance", "success", "cost")
    )
    return Outcomes(np.arange(len(cost)), distance, success, cost)


def _share(cost: Array) -> float:
    return float(np.isfinite(cost).mean())
