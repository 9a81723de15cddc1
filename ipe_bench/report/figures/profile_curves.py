"""Performance and data profiles over all scenarios."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import Look
from ipe_bench.report.words import percent
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.profiles import BUDGETS, RATIOS


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    performance, data = (_shares(analysis.profiles, profile) for profile in ("performance", "data"))
    there = {label: one for label, one in look.items() if label in performance}
    if len(there) < 2:
        return
    fig, axes = common.panels(2, height=3.2, extra=0.3 + 0.2 * len(there) / 5)
    left, right = axes
    for label, one in there.items():
        style = one.line | {"drawstyle": "steps-post", "markersize": 4.5, "linewidth": 1.4}
        offset = list(there).index(label) * 3
        left.plot(RATIOS, performance[label], label=common.text(label), markevery=(offset, 45), **style)
        right.plot(BUDGETS, data[label], label=common.text(label), markevery=(offset, 45), **style)
    for ax, x, title in (
        (left, "cost over the cheapest estimator's", "performance profile"),
        (right, "simulations per trial", "data profile"),
    ):
        ax.set_xscale("log")
        ax.set_ylim(-0.03, 1.03)
        ax.yaxis.set_major_formatter(lambda v, _: f"{100 * v:.0f} %")
        ax.set_xlabel(x)
        ax.set_ylabel("share of trials with success")
        ax.set_title(title)
    left.set_xlim(1, _end(RATIOS, [performance[e] for e in there]))
    right.set_xlim(1, _end(BUDGETS, [data[e] for e in there]))
    for ax in axes:
        common.log_ticks(ax.xaxis, *ax.get_xlim())
    common.legend_below(fig, axes)
    final = {label: float(data[label][-1]) for label in there}
    first = {label: float(performance[label][0]) for label in there}
    robust, cheap = max(final, key=lambda e: final[e]), max(first, key=lambda e: first[e])
    caption = (
        "All trials of all scenarios. Left (Dolan and Moré): share of trials in which an estimator succeeds at a cost"
        " of at most the abscissa times that of the cheapest success. Right (Moré and Wild): share in which it succeeds"
        " within that many simulations, a Jacobian counting as many as there are parameters."
        f" {cheap} is the cheapest most often ({percent(first[cheap])}); {robust} succeeds most often"
        f" ({percent(final[robust])})."
    )
    yield Drawing("profiles", "Performance and data profiles", caption, fig)


def _shares(profiles: pd.DataFrame, profile: str) -> dict[str, np.ndarray]:
    part = profiles[profiles["profile"] == profile]
    return {str(label): rows["share"].to_numpy() for label, rows in part.groupby("estimator", sort=False)}


def _end(x: np.ndarray, curves: list[np.ndarray]) -> float:
    """A little behind the point from which on no curve rises."""
    rising = [int(np.argmax(curve >= curve[-1])) for curve in curves]
    return float(max(x[min(max(rising) + 12, len(x) - 1)], 4.0))
