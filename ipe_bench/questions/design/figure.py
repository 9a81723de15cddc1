"""Draws the bounds of a design."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.questions.panels import labelled_rows
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, FAMILIES

if TYPE_CHECKING:
    from ipe_bench.trials.observability import Observability


def draw_bounds(now: Observability, after: Observability | None, choice: str) -> Iterator[Drawing]:
    """Draws the bound of each parameter in its unit, today and after a `choice` of readings."""
    sizes = np.array([p.size for p in now.parameters])
    fig, (ax,) = labelled_rows(
        [f"{p.name} [{p.unit}]" if p.unit else p.name for p in now.parameters], 1
    )
    y = np.arange(len(now.parameters))
    known, today = np.isfinite(now.bound), sizes * now.bound
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
    caption = "Cramér-Rao bound of each parameter's standard deviation, root mean square over truths from the prior."
    if not known.all():
        caption += " Without a hollow mark: today's readings leave the parameter open."
    title = "Bounds today" if after is None else "Bounds today and after the best choice"
    yield Drawing("design", title, caption, fig)
