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
from ipe_bench.report.style import BOUND_COLOR, RAMP
from ipe_bench.report.words import percent
from ipe_bench.statistics.certified import SOLVED, certified_table, published_table

_FOUND = "#0b5a8f"
_STEPS = {0: RAMP[0], 1: RAMP[4], 2: RAMP[8], 3: RAMP[11], SOLVED: RAMP[18], 8: RAMP[20]}
"""Colours from so many digits on: dark where a problem is solved."""


_LETTERS = 9.5
"""Points of letters in and beside the cells."""
_CELL = (0.28, 0.21)
"""Inches of a cell."""


def draw_digits(view: View) -> Iterator[Drawing]:
    """Draws the digits of each certified problem by estimator, the hardest problem and the best
    estimator first."""
    table = pd.DataFrame() if view.collection is None else certified_table(view.collection)
    if table.empty:
        return
    table["digits"] = np.floor(table["lre_parameters"].fillna(0.0))
    of_problems = table.groupby("dataset")["digits"].mean()
    of_estimators = table.groupby("estimator")["digits"].mean()
    problems = of_problems.sort_values().index
    estimators = of_estimators.sort_values().index[::-1]
    starts = sorted(set(table["start"]))
    fig, axes = common.panels(len(starts), row=2)
    width = 1.1 + _CELL[0] * len(estimators)
    fig.set_size_inches(width * len(axes), 2.0 + _CELL[1] * len(problems))
    for start, ax in zip(starts, axes, strict=True):
        here = table[table["start"] == start]
        digits = here.pivot_table("digits", "dataset", "estimator")
        _draw_cells(ax, digits.reindex(index=problems, columns=estimators))
        ax.set(xlabel="", ylabel="", title=f"start {start}")
    best = str(estimators[0])
    is_solved = table["digits"][table["estimator"] == best] >= SOLVED
    share = percent(float(is_solved.mean()))
    caption = (
        f"Of the parameter with fewest; dark: {SOLVED} or more, solved. Hardest problems first,"
        f" best estimators left: {best} solves {share}."
    )
    yield view.drawing(fig, "digits", "Correct digits of certified parameters, of 11", caption)


def _draw_cells(ax: Any, digits: pd.DataFrame) -> None:
    """Draws a coloured cell with each number of digits, and the names beside the cells."""
    reached = np.searchsorted(list(_STEPS), digits, side="right") - 1.0
    words = digits.map("{:.0f}".format)
    places = pd.DataFrame(reached, digits.index, digits.columns).where(digits.notna())
    common.tiles(ax, places, list(_STEPS.values()), words, _LETTERS, linewidths=0.8)
    names = [common.text(estimator) for estimator in digits.columns]
    ax.set_xticks(ax.get_xticks(), names, rotation=90, fontsize=_LETTERS)
    middles = np.arange(len(digits)) + 0.5
    ax.set_yticks(middles, list(digits.index), rotation=0, fontsize=_LETTERS)


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
    names: Any = dict.fromkeys(table["estimator"])
    fig, axes = common.panels(len(groups), names, scales=[0.0])
    for ((model, state), rows), ax in zip(groups, axes, strict=True):
        _draw_rings(ax, rows.sort_values("published"))
        common.title(ax, f"{model}, {with_unit(str(state), units[str(state)])}")
    common.legend(fig, axes)
    most = table["difference"].abs().max()
    caption = f"Errors along the published path; the largest difference is {most:.1e}."
    yield view.drawing(fig, "published", "Published errors and those found", caption)


def _draw_rings(ax: Any, rows: pd.DataFrame) -> None:
    """Draws the errors of estimators, a row for each, within the published ones."""
    common.name_axis(ax, list(rows["estimator"]))
    y = np.arange(len(rows))
    ring: Any = {"markersize": 9, "markerfacecolor": "white", "color": BOUND_COLOR}
    ax.plot(rows["published"], y, "o", label="published", **ring)
    ax.plot(rows["found"], y, "o", markersize=4, color=_FOUND, label="found")
    ax.set(xlabel="root mean square error", xlim=(0, None))


FIGURES = (
    Figure(draw_digits, ("summary",), together=True, main=True),
    Figure(draw_published, ("summary",), together=True, main=True),
)
