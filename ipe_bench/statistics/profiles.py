"""What success costs: performance and data profiles. A trial without success costs infinitely much."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.comparisons import Outcomes, common

RATIOS = np.unique(np.round(np.geomspace(1, 1000, 181), 6))
BUDGETS = np.unique(np.round(np.geomspace(1, 100_000, 301)))


@dataclass
class Profiles:
    """Counts over all scenarios; `add` takes one scenario after another, so that trials need not be kept."""

    trials: dict[str, int] = field(default_factory=dict)
    within_ratio: dict[str, Array] = field(default_factory=dict)
    within_budget: dict[str, Array] = field(default_factory=dict)

    def add(self, outcomes: Mapping[str, Outcomes]) -> None:
        paired = common(outcomes)
        costs = {label: np.where(o.success, o.cost, np.inf) for label, o in paired.items()}
        if not costs:
            return
        best = np.full(len(next(iter(costs.values()))), np.inf)
        for cost in costs.values():
            best = np.minimum(best, cost)
        for label, cost in costs.items():
            solved = np.isfinite(cost)
            # A cost of nothing (nobody simulates) is the best there is.
            ratio = np.divide(cost[solved], best[solved], out=np.ones(int(solved.sum())), where=best[solved] > 0)
            self.trials[label] = self.trials.get(label, 0) + len(cost)
            self._count(self.within_ratio, label, ratio, RATIOS * (1 + 1e-9))
            self._count(self.within_budget, label, cost[solved], BUDGETS)

    def _count(self, counts: dict[str, Array], label: str, values: Array, limits: Array) -> None:
        within = np.searchsorted(np.sort(values), limits, side="right")
        counts[label] = counts.get(label, 0) + within

    def performance(self, label: str) -> Array:
        """Share of trials solved at a cost of at most `RATIOS` times the cheapest estimator's (Dolan and Moré, Math.
        Program. 91, 2002)."""
        return self.within_ratio[label] / max(1, self.trials[label])

    def data(self, label: str) -> Array:
        """Share of trials solved within `BUDGETS` simulations (Moré and Wild, SIAM J. Optim. 20, 2009)."""
        return self.within_budget[label] / max(1, self.trials[label])

    def frame(self) -> pd.DataFrame:
        """Both profiles of every estimator: estimator, profile, `at` (ratio or budget) and share."""
        parts = [
            pd.DataFrame({"estimator": label, "profile": profile, "at": at, "share": share(label)})
            for label in self.trials
            for profile, at, share in (("performance", RATIOS, self.performance), ("data", BUDGETS, self.data))
        ]
        columns = ["estimator", "profile", "at", "share"]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)
