"""The headline: what the data say, in a sentence or two that are computed from them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ipe_bench.report.certified_tables import without_certified
from ipe_bench.report.style import REFERENCE
from ipe_bench.report.words import enumerate_few, percent, plain, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.attained import attained_totals
from ipe_bench.statistics.digits import certified_averages, certified_table
from ipe_bench.statistics.summary import ALL

NEAR = 0.005
"""Capped errors within this part of the smallest count as equally good."""


def headline(analysis: Analysis) -> str:
    """Who solves most on certified readings and on problems of known minimum, and who is best on simulated ones."""
    simulated = without_certified(analysis)
    sentences = [*_certified(analysis), *_attained(analysis)]
    if not simulated.summary.empty:
        sentences.append(_simulated(simulated))
    return " ".join(sentences) or "Nothing is stored yet, so there is nothing to find."


def _certified(analysis: Analysis) -> Iterator[str]:
    averages = certified_averages(certified_table(analysis.collection))
    if averages.empty:
        return
    each = averages.assign(digits=averages["mean_lre_parameters"] * averages["datasets"])
    totals = each.groupby("estimator", sort=False)[["solved", "datasets", "digits"]].sum()
    best = totals[totals["solved"] == totals["solved"].max()].sort_values("digits", ascending=False, kind="stable")
    first = best.iloc[0]
    yield (
        f"Of {first['datasets']:.0f} certified problems, {enumerate_few(list(best.index))} solve"
        f"{'s' if len(best) == 1 else ''} most, {first['solved']:.0f}, with four digits or more of every parameter;"
        f" {best.index[0]} has {first['digits'] / first['datasets']:.1f} of 11 digits on average."
    )


def _attained(analysis: Analysis) -> Iterator[str]:
    totals = attained_totals(analysis.attained) if len(analysis.attained) else analysis.attained
    if totals.empty:
        return
    best = totals[totals["solved"] == totals["solved"].max()]
    yield (
        f"Of {best['problems'].iloc[0]} problems of known minimum, {enumerate_few(list(best['estimator']))} attain"
        f"{'s' if len(best) == 1 else ''} most, {best['solved'].iloc[0]}."
    )


def _simulated(analysis: Analysis) -> str:
    """Who is best over all scenarios, how far that holds, and how the linear estimate fares where it is worst."""
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
    worst = _least_efficient(own)
    if worst is not None:
        sentence += f", and where it does worst (scale {plain(worst['error_scale'])}) {_efficiency(worst)}"
    sentences = [sentence + "."]
    linear = rows[rows["estimator"] == REFERENCE]
    if best != REFERENCE and len(linear):
        at = linear.iloc[int(np.argmax(linear["error_scale"].to_numpy()))]
        sentences.append(
            f"At scale {plain(at['error_scale'])} the linear estimate has an efficiency of"
            f" {short(at['efficiency_all'])}, and succeeds in {percent(at['success'])} of trials."
        )
    # A number and its sign stay on one line.
    return " ".join(sentences).replace(" %", "\u00a0%")


def _least_efficient(rows: pd.DataFrame) -> pd.Series | None:
    """The scenario with the smallest efficiency over all trials, or where that tells nothing over solved ones."""
    for name in ("efficiency_all", "efficiency"):
        values = rows[name].to_numpy(dtype=float)
        if np.isfinite(values).any():
            return rows.iloc[int(np.nanargmin(values))]
    return None


def _efficiency(row: pd.Series) -> str:
    """Efficiency against the bound that applies at that scale, and of which trials."""
    text = f"its efficiency, the bound that applies over its error, is {short(row['efficiency_all'])}"
    if row["solved_trials"] < row["trials"] and row["equation"] != "-":
        text += f" over all trials, and {short(row['efficiency'])} over the {row['solved_trials']} that it solves"
    if np.isfinite(row["efficiency_low"]):
        text += f" (95 % interval {short(row['efficiency_low'])} to {short(row['efficiency_high'])})"
    return text


def best_estimator(analysis: Analysis) -> str:
    """The estimator that `best_of` finds over all scenarios."""
    return best_of(analysis.scores, analysis.summary)


def best_of(scores: pd.DataFrame, summary: pd.DataFrame) -> str:
    """The estimator with the smallest mean capped error over the scenarios that most estimators have.

    Of those within `NEAR` of it the one that succeeds most, and of those the cheapest. Both frames are of the same
    scenarios and estimators, in the same order.
    """
    success = summary.loc[summary["parameter"] == ALL, "success"].to_numpy()
    scores = scores.assign(success=success)
    counts = scores.groupby("estimator", sort=False).size()
    scores = scores[scores["estimator"].isin(counts.index[counts == counts.max()])]
    means = scores.groupby("estimator", sort=False)[["capped_error", "success", "cost_median"]].mean()
    means = means[means["capped_error"] <= means["capped_error"].min() * (1 + NEAR)]
    means = means[means["success"] >= means["success"].max() - 1e-9]
    return str(means.index[int(np.argmin(means["cost_median"].to_numpy()))])
