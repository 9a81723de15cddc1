"""Draws answers beside those that are certified or published: the digits that agree, and the errors
that are met."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.measurements.base import with_unit
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import BOUND_COLOR, RAMP, ink
from ipe_bench.report.words import percent
from ipe_bench.statistics.certified import certified_table, published_table

SOLVED = 4
"""Digits from which on a problem is solved."""
_STEPS = {0: RAMP[0], 1: RAMP[4], 2: RAMP[8], 3: RAMP[11], SOLVED: RAMP[18], 8: RAMP[20]}
"""Colours from so many digits on: dark where a problem is solved."""


def draw_digits(view: View) -> Iterator[Drawing]:
    """Draws the digits of each certified problem by estimator, the hardest problem and the best
    estimator first."""
    table = pd.DataFrame() if view.collection is None else certified_table(view.collection)
    if table.empty:
        return
    table["digits"] = np.floor(table["lre_parameters"].fillna(0.0))
    of_problems = table.groupby("dataset")["digits"].mean().sort_values()
    of_estimators = table.groupby("estimator")["digits"].mean().sort_values()
    problems = of_problems.index
    estimators = of_estimators.index[::-1]
    starts = sorted(set(table["start"]))
    fig, axes = common.panels(len(starts), row=2)
    fig.set_size_inches(1.3 + 4.4 * len(axes), 1.8 + 0.2 * len(problems))
    for start, ax in zip(starts, axes, strict=True):
        here = table[table["start"] == start].pivot_table("digits", "dataset", "estimator")
        _draw_cells(ax, here.reindex(index=problems, columns=estimators))
        ax.set(xlabel="", ylabel="", title=f"start {start}")
        ax.set_xticks(ax.get_xticks(), [common.text(e) for e in estimators], rotation=90)
        ax.set_yticks(np.arange(len(problems)) + 0.5, list(problems), rotation=0)
    best = str(estimators[0])
    solved = table["digits"][table["estimator"] == best] >= SOLVED
    yield view.drawing(
        fig,
        "digits",
        "Correct digits of certified parameters, of 11",
        f"Of the parameter with fewest; dark: {SOLVED} or more, solved. Hardest problems first,"
        f" best estimators left: {best} solves {percent(float(solved.mean()))}.",
    )


def _draw_cells(ax: Any, digits: pd.DataFrame) -> None:
    """Draws a coloured cell with each number of digits."""
    import seaborn as sns
    from matplotlib.colors import BoundaryNorm, ListedColormap

    norm = BoundaryNorm([*_STEPS, 99], len(_STEPS))
    colors = ListedColormap(list(_STEPS.values()))
    style: Any = {"cbar": False, "annot": True, "fmt": ".0f", "linewidths": 0.8}
    sns.heatmap(digits, ax=ax, cmap=colors, norm=norm, **style)
    for text in ax.texts:
        step = max(k for k in _STEPS if k <= int(text.get_text()))
        text.set(color=ink(_STEPS[step]), fontsize="small")


def draw_published(view: View) -> Iterator[Drawing]:
    """Draws errors that were found within rings of those that are published, the smallest first."""
    if view.collection is None:
        return
    table = published_table(view.collection)
    if table.empty:
        return
    footers = [group.footer for group in view.collection.groups]
    units = {p["name"]: p["unit"] for footer in footers for p in footer["parameters"]}
    groups = list(table.groupby(["model", "state"], sort=False))[: common.MOST_PANELS]
    fig, axes = common.panels(len(groups), dict.fromkeys(table["estimator"]), scales=[0.0])  # type: ignore[arg-type]
    for ((model, state), rows), ax in zip(groups, axes, strict=True):
        rows = rows.sort_values("published")
        common.name_axis(ax, list(rows["estimator"]))
        ring: Any = {"markersize": 9, "markerfacecolor": "white", "color": BOUND_COLOR}
        y = np.arange(len(rows))
        ax.plot(rows["published"], y, "o", label="published", **ring)
        ax.plot(rows["found"], y, "o", markersize=4, color="#0b5a8f", label="found")
        ax.set(xlabel="root mean square error", xlim=(0, None))
        common.title(ax, f"{model}, {with_unit(str(state), units[str(state)])}")
    common.legend(fig, axes)
    most = table["difference"].abs().max()
    caption = f"Errors along the published path; the largest difference is {most:.1e}."
    yield view.drawing(fig, "published", "Published errors and those found", caption)


FIGURES = (
    Figure(draw_digits, ("summary",), together=True, main=True),
    Figure(draw_published, ("summary",), together=True, main=True),
)
