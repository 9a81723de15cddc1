"""The headline: what the data say, in a sentence or two that are computed from them."""

from __future__ import annotations

import numpy as np
import pandas as pd

from ipe_bench.report.style import REFERENCE
from ipe_bench.report.words import percent, plain, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL

NEAR = 0.005
"""Capped errors within this part of the smallest count as equally good."""


def headline(analysis: Analysis) -> str:
    """Who is best over all scenarios, how far that holds, and how the linear estimate fares where it is worst."""
    if analysis.summary.empty:
        return "Nothing is stored yet, so there is nothing to find."
    rows = analysis.summary[analysis.summary["parameter"] == ALL]
    best = best_estimator(analysis)
    own = rows[rows["estimator"] == best].sort_values("error_scale")
    trials = int(own["trials"].sum())
    success = float((own["success"] * own["trials"]).sum() / trials)
    scales = sorted(own["error_scale"].unique())
    reach = f"error scale {plain(scales[0])}"
    if len(scales) > 1:
        reach = f"error scales {plain(scales[0])} to {plain(scales[-1])}"
    scenarios = f" in {len(own)} scenarios" if len(own) > len(scales) else ""
    sentence = f"At {reach}{scenarios}, {best} succeeds in {percent(success)} of {trials:,} trials"
    over = own["rmse_over_linear_bound"].to_numpy()
    if np.isfinite(over).any():
        worst = own.iloc[int(np.nanargmax(over))]
        sentence += (
            f", and where it does worst (scale {plain(worst['error_scale'])}) the root mean square error of the trials"
            f" it solves is {short(worst['rmse_over_linear_bound'])} times the linear bound"
            f" (95 % interval {short(worst['rmse_low'])} to {short(worst['rmse_high'])})"
        )
    sentences = [sentence + "."]
    linear = rows[rows["estimator"] == REFERENCE]
    if best != REFERENCE and len(linear):
        at = linear.iloc[int(np.argmax(linear["error_scale"].to_numpy()))]
        if np.isfinite(at["rmse_over_linear_bound"]):
            sentences.append(
                f"The linear estimate is off by {short(at['rmse_over_linear_bound'])} times that bound at scale"
                f" {plain(at['error_scale'])}, and succeeds there in {percent(at['success'])} of trials."
            )
    # A number and its sign stay on one line.
    return " ".join(sentences).replace(" %", "\u00a0%")


def best_estimator(analysis: Analysis) -> str:
    """The estimator that `best_of` finds over all scenarios."""
    return best_of(analysis.scores, analysis.summary)


def best_of(scores: pd.DataFrame, summary: pd.DataFrame) -> str:
    """The estimator with the smallest mean capped error over the scenarios that most estimators have.

    Of those within `NEAR` of it the one that solves most, and of those the cheapest. Both frames are of the same
    scenarios and estimators, in the same order.
    """
    solved = summary.loc[summary["parameter"] == ALL, "solved"].to_numpy()
    scores = scores.assign(solved=solved)
    counts = scores.groupby("estimator", sort=False).size()
    scores = scores[scores["estimator"].isin(counts.index[counts == counts.max()])]
    means = scores.groupby("estimator", sort=False)[["capped_error", "solved", "cost_median"]].mean()
    means = means[means["capped_error"] <= means["capped_error"].min() * (1 + NEAR)]
    means = means[means["solved"] >= means["solved"].max() - 1e-9]
    return str(means.index[int(np.argmin(means["cost_median"].to_numpy()))])
