"""Draws the bounds of a design, and what further readings would make of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.measurements.base import labels, with_unit
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, COLORS, FAMILIES

MOST_PARAMETERS = 4
"""Parameters that have curves: those that gain most."""

if TYPE_CHECKING:
    from ipe_bench.measurements.base import Measurement
    from ipe_bench.questions.design.maths import Further
    from ipe_bench.trials.observability import Observability


def draw_further(model: Measurement, further: Further) -> Drawing:
    """Draws bounds, as shares of today's, over the number of further readings, and over where one
    more is taken."""
    today = further.bounds[0]
    shares = further.bounds / today
    shown = np.argsort(shares[-1], kind="stable")[:MOST_PARAMETERS]
    fig, axes = common.panels(2 if further.column else 1, height=3.0)
    by_number, *by_place = axes
    for i, k in enumerate(shown):
        p = model.parameters[k]
        line: Any = {"color": COLORS[i], "label": common.text(p.name), "zorder": 3 - 0.1 * i}
        by_number.plot(range(len(shares)), shares[:, k], "o-", **line)
        for ax in by_place:
            ax.plot(further.entries, further.alone[:, k] / today[k], **line)
    by_number.set_xlabel("further readings, where they help most")
    for ax in by_place:
        _mark_places(ax, model, further)
    for ax in axes:
        common.decades(ax, shares[:, shown], least=1.25)
        ax.set_ylabel("bound over today's")
    common.legend(fig, axes)
    caption = "Cramér-Rao bounds with further readings."
    if further.column:
        caption += f" Over {further.column}: with one more, by where it is taken."
    left = len(today) - len(shown)
    if left:
        parameters = "1 parameter that gains" if left == 1 else f"{left} parameters that gain"
        caption += f" Not drawn: {parameters} less."
    return Drawing("further", f"Read next at {further.words[further.taken[0]]}", caption, fig)


def _mark_places(ax: Any, model: Measurement, further: Further) -> None:
    """Marks where readings are taken today, and where the next one helps most."""
    ax.set_xlabel(common.text(further.column))
    best = further.entries[further.taken[0]]
    ax.axvline(best, color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0, label="next")
    given = np.asarray(labels(model)[further.column], dtype=float)
    style: Any = {"linestyle": "none", "color": BOUND_COLOR, "clip_on": False}
    ax.plot(given, np.ones(len(given)), marker="|", label="today's readings", **style)


def draw_bounds(
    now: Observability, after: Observability | None, choice: str, where: str
) -> Iterator[Drawing]:
    """Draws the bound of each parameter in its unit at a point, today and after a `choice` of
    readings."""
    from matplotlib.figure import Figure

    sizes = np.array([p.size for p in now.parameters])
    names = [common.text(with_unit(p.name, p.unit)) for p in now.parameters]
    width = 0.07 * max(map(len, names)) + 4.5
    size = (width, 1.1 + 0.26 * len(names))
    fig = Figure(figsize=size, layout="constrained")
    ax = fig.subplots()
    y = np.arange(len(names))
    ax.set_yticks(y, names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    known = np.isfinite(now.bound)
    today = sizes * now.bound
    chosen = today if after is None else sizes * after.bound
    common.decades(ax, np.append(today, chosen))
    if after is not None:
        ax.hlines(y[known], today[known], chosen[known], color=BOUND_COLOR, linewidth=1.0, zorder=1)
    hollow: Any = {"markerfacecolor": "white", "markersize": 8, "markeredgewidth": 1.0}
    ax.plot(today[known], y[known], "o", color=BOUND_COLOR, label="today", **hollow)
    if after is not None:
        ax.plot(chosen, y, "o", color=FAMILIES["IPE"][0], label=choice)
    ax.set_xlabel("bound, in the unit of each row")
    common.legend(fig, [ax])
    caption = (
        f"Cramér-Rao bound of each parameter's standard deviation, at the true values of {where}."
    )
    if not known.all():
        caption += " Without a hollow mark: today's readings leave the parameter open."
    title = "Bounds today" if after is None else "Bounds today and after the best choice"
    yield Drawing("design", title, caption, fig)
