"""The critical-difference diagram: mean ranks over scenarios, and who cannot be told apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import Look
from ipe_bench.report.words import p_value
from ipe_bench.statistics.analysis import Analysis


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    ranking = analysis.ranking
    if ranking is None or len(ranking.mean_ranks) < 3 or not look.keys() >= ranking.mean_ranks.keys():
        return
    ordered = sorted(ranking.mean_ranks, key=lambda label: ranking.mean_ranks[label])
    k, difference = len(ordered), ranking.critical_difference
    bars = cliques([ranking.mean_ranks[label] for label in ordered], difference)
    fig = common.figure(8.2, 0.55 + 0.27 * k + 0.12 * len(bars))
    ax = fig.subplots()
    for place, label in enumerate(ordered):
        rank = ranking.mean_ranks[label]
        ax.plot([0.4, rank], [place, place], color="#d0d0d0", linewidth=1.0, zorder=1)
        line = look[label].line | {"linestyle": "none", "markersize": 8}
        ax.plot([rank], [place], **line)
        ax.annotate(f"{rank:.2f}", (rank, place), xytext=(8, 0), textcoords="offset points", va="center", fontsize=8)
    ax.set_yticks(range(k), [common.text(label) for label in ordered])
    for i, (first, last) in enumerate(bars):
        y = k - 0.35 + 0.42 * i
        low, high = ranking.mean_ranks[ordered[first]], ranking.mean_ranks[ordered[last]]
        ax.plot([low - 0.05, high + 0.05], [y, y], color="#222222", linewidth=3.5, solid_capstyle="round")
    ax.set_ylim(k - 0.35 + 0.42 * max(len(bars), 1), -0.6)
    ax.set_xlim(0.8, k + 0.55)
    ax.set_xticks(range(1, k + 1))
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"mean rank over {ranking.scenarios} scenarios (1 is best); critical difference {difference:.2f}")
    alike = "; ".join(" = ".join(ordered[a : b + 1]) for a, b in bars)
    caption = (
        f"Mean ranks over {ranking.scenarios} scenarios by capped mean error (ties share ranks). Bars join estimators"
        f" whose ranks differ by less than Nemenyi's critical difference of {difference:.2f}: they cannot be told apart"
        f" at 5 %. Friedman's test that all rank alike: p = {p_value(ranking.friedman)}."
        + (f" Not told apart: {alike}." if alike else "")
    )
    yield Drawing("critical_difference", "Ranks over scenarios", caption, fig)


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
