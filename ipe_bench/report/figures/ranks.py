"""The critical-difference diagram: mean ranks over seeds, and who cannot be told apart."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.words import p_value


def draw(view: View) -> Iterator[Drawing]:
    ranking = view.ranking
    if ranking is None or len(ranking.mean_ranks) < 3 or not view.look.keys() >= ranking.mean_ranks.keys():
        return
    import seaborn as sns

    ordered = sorted(ranking.mean_ranks, key=lambda label: ranking.mean_ranks[label])
    k, difference = len(ordered), ranking.critical_difference
    ranks = [ranking.mean_ranks[label] for label in ordered]
    bars = cliques(ranks, difference)
    fig = common.figure(8.2, 0.55 + 0.27 * k + 0.12 * len(bars))
    ax = fig.subplots()
    ax.hlines(range(k), 0.4, ranks, color="#d0d0d0", linewidth=1.0, zorder=1)
    rows = pd.DataFrame({"estimator": ordered, "rank": ranks, "place": range(k)})
    markers = {label: view.look[label].marker for label in ordered}
    style = common.seaborn_style(view.with_look(ordered))
    sns.scatterplot(rows, x="rank", y="place", markers=markers, s=64, ax=ax, zorder=2, **style)
    for place, rank in enumerate(ranks):
        ax.annotate(f"{rank:.2f}", (rank, place), xytext=(8, 0), textcoords="offset points", va="center", fontsize=8)
    for i, (first, last) in enumerate(bars):
        y = k - 0.35 + 0.42 * i
        ax.plot([ranks[first] - 0.05, ranks[last] + 0.05], [y, y], color="#222", linewidth=3.5, solid_capstyle="round")
    ax.set_yticks(range(k), [common.text(label) for label in ordered])
    ax.set_ylim(k - 0.35 + 0.42 * max(len(bars), 1), -0.6)
    ax.set_xlim(0.8, k + 0.55)
    ax.set_xticks(range(1, k + 1))
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"mean rank over {ranking.replicates} seeds (1 is best); critical difference {difference:.2f}")
    ax.set_ylabel("")
    alike = "; ".join(" = ".join(ordered[a : b + 1]) for a, b in bars)
    caption = common.sentence(
        f"Mean ranks over {ranking.replicates} seeds by capped mean error (ties share ranks). Bars join estimators"
        f" whose ranks differ by less than Nemenyi's critical difference of {difference:.2f}: they cannot be told apart"
        f" at 5 %. Friedman's test that all rank alike: p = {p_value(ranking.friedman)}.",
        f"Not told apart: {alike}." if alike else "",
    )
    yield Drawing("critical_difference", "Ranks over seeds", caption, fig)


def cliques(ranks: list[float], difference: float) -> list[tuple[int, int]]:
    """Longest runs (first, last) of ascending ranks within the difference, of at least two, none inside another."""
    runs: list[tuple[int, int]] = []
    for first in range(len(ranks)):
        last = first
        while last + 1 < len(ranks) and ranks[last + 1] - ranks[first] < difference:
            last += 1
        if last > first and not (runs and runs[-1][1] >= last):
            runs.append((first, last))
    return runs


FIGURE = Figure(draw, (), together=True)
