"""Cost against accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.words import plain

LEAST_COST = 0.5
"""What does not simulate at all stands here: a logarithmic axis has no zero."""
FEW_ESTIMATORS = 3
"""So many share one panel, each with its way over the error scales; more have a panel per scale."""


def draw(view: View) -> Iterator[Drawing]:
    scores = view["scores"]
    scores = scores.assign(
        cost=np.maximum(scores["cost_median"], LEAST_COST), error=scores["capped_error"] / view.n**0.5
    )
    scores = scores[np.isfinite(scores["cost"]) & np.isfinite(scores["error"])]
    if scores.empty:
        return
    look = view.with_look(scores["estimator"])
    scales = common.spread(view.scales)
    together = len(look) <= FEW_ESTIMATORS and len(scales) > 1
    fig, axes = common.panels(1 if together else len(scales), look, height=3.2 if together else 2.7)
    if together:
        _ways(axes[0], scores, view)
    else:
        for scale, ax in zip(scales, axes, strict=True):
            _points(ax, common.at_scale(scores, scale), view)
            ax.set_title(f"error scale {plain(scale)}")
    for ax in axes:
        common.bound_line(ax, efficient(view.n), "efficient")
        ax.set_xscale("log")
        ax.set_xlim(scores["cost"].min() / 1.5, scores["cost"].max() * 1.5)
        common.log_ticks(ax.xaxis, *ax.get_xlim())
        low, high = min(0.8, scores["error"].min()), max(1.0, scores["error"].max())
        ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
        ax.set(xlabel="simulations per trial (median)", ylabel="mean error / √n, capped")
    common.legend_below(fig, axes, look)
    last = common.at_scale(scores, view.scales[-1])
    good = last[last["error"] <= last["error"].min() * 1.05].sort_values("cost_median", kind="stable").iloc[0]
    caption = common.sentence(
        "Median cost of a trial in simulations, a Jacobian counting as many as there are parameters, against the mean"
        " Mahalanobis error over √n, each trial's capped at the gate of success; down and left is better.",
        "Numbers: error scales." if together else "",
        f"The cheapest within 5 % of the best error at scale {plain(view.scales[-1])}: {good['estimator']}"
        f" ({good['cost_median']:g} simulations). {view.label}.",
    )
    yield Drawing(f"cost_against_accuracy{view.suffix}", "Cost against accuracy", caption, fig)


def efficient(n: int) -> float:
    """What an efficient estimator's mean error is over √n: the mean of a chi distribution with n degrees."""
    return math.sqrt(2 / n) * math.exp(math.lgamma((n + 1) / 2) - math.lgamma(n / 2))


def _points(ax: Any, rows: pd.DataFrame, view: View) -> None:
    look = view.with_look(rows["estimator"])
    # Equal points lie upon each other: the later ones are smaller, so that all are seen.
    areas = dict(zip(look, common.mark_scale() ** 2 * np.linspace(110, 40, len(look)), strict=True))
    labels = list(rows["estimator"])
    common.marks(ax, rows["cost"], rows["error"], [look[e] for e in labels], [areas[e] for e in labels], linewidth=0.7)


def _ways(ax: Any, rows: pd.DataFrame, view: View) -> None:
    look = view.with_look(rows["estimator"])
    rows = rows.sort_values("error_scale", kind="stable")
    common.lines(ax, rows, "cost", "error", look, linewidth=1, sort=False)
    _points(ax, rows, view)
    # Points that lie upon each other share one note.
    notes: dict[tuple[float, float], list[tuple[float, float, str]]] = {}
    for cost, error, scale in zip(rows["cost"], rows["error"], rows["error_scale"], strict=True):
        notes.setdefault((round(math.log10(cost), 1), round(error, 1)), []).append((cost, error, plain(scale)))
    for points in notes.values():
        cost, error, _ = points[-1]
        words = ", ".join(dict.fromkeys(scale for *_, scale in points))
        ax.annotate(words, (cost, error), xytext=(6, 6), textcoords="offset points", fontsize=7)


FIGURE = Figure(draw, ("scores",))
