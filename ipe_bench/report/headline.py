"""The headline: what the data say, in a sentence or two that are computed from them."""

from __future__ import annotations

import numpy as np
import pandas as pd

from ipe_bench.report.figures.common import plain
from ipe_bench.report.style import REFERENCE
from ipe_bench.report.terminal import percent, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL


def headline(analysis: Analysis) -> str:
    """Who is best over all scenarios, how far that holds, and how the linear estimate fares where it is worst.

    The best estimator is the one with the largest mean share of successes over scenarios; of those within one trial of
    it, the one that needs the fewest simulations.
    """
    rows = analysis.summary[analysis.summary["parameter"] == ALL] if len(analysis.summary) else analysis.summary
    if rows.empty:
        return "Nothing is stored yet, so there is nothing to find."
    best = best_estimator(rows)
    mine = rows[rows["estimator"] == best].sort_values("error_scale")
    top = mine.iloc[-1]
    scales = mine["error_scale"].unique()
    reach = (
        f"error scale {plain(scales[0])}"
        if len(scales) == 1
        else f"error scales {plain(scales[0])} to {plain(scales[-1])}"
    )
    over = mine["rmse_over_linear_bound"].to_numpy()
    worst = mine.iloc[int(np.nanargmax(over))] if np.isfinite(over).any() else top
    trials = int(mine["trials"].sum())
    success = float((mine["success"] * mine["trials"]).sum() / trials)
    sentences = [
        f"At {reach}, {best} succeeds in {percent(success)} of {trials} trials"
        f" with at most {short(worst['rmse_over_linear_bound'])} times the linear bound"
        f" (95 % interval {short(worst['rmse_low'])} to {short(worst['rmse_high'])},"
        f" at scale {plain(worst['error_scale'])}),"
        f" for a median of {short(float(mine['simulations_median'].max()))} simulations where it needs most."
    ]
    linear = rows[rows["estimator"] == REFERENCE]
    if best != REFERENCE and len(linear):
        at = linear.iloc[int(np.argmax(linear["error_scale"].to_numpy()))]
        value = at["rmse_over_linear_bound"]
        if np.isfinite(value):
            sentences.append(
                f"The linear estimate ({REFERENCE}) errs by {short(value)} times that bound at scale"
                f" {plain(at['error_scale'])} and succeeds in {percent(at['success'])} of trials there."
            )
    return " ".join(sentences)


def best_estimator(rows: pd.DataFrame) -> str:
    """The label that the headline is about; see `headline`."""
    scenarios = rows.groupby("estimator", sort=False).size()
    everywhere = rows[rows["estimator"].isin(scenarios[scenarios == scenarios.max()].index)]
    by = everywhere.groupby("estimator", sort=False)
    success, cost = by["success"].mean(), by["simulations_median"].mean()
    near = success[success >= success.max() - 1 / rows["trials"].min()].index
    return str(cost[near].idxmin())
