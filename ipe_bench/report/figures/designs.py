"""The picture of a design: the bound against the number of readings, and each parameter's bound with what is chosen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, house_style, looks
from ipe_bench.report.words import plain
from ipe_bench.trials.design import Choice, Design
from ipe_bench.trials.observability import Observability, truths_of

_WORST = 10.0
"""Bounds above this many times today's are off the picture."""


def draw_design(design: Design) -> Iterator[Drawing]:
    """One figure; nothing where there is nothing to choose."""
    if not design.ways:
        return
    with house_style():
        fig = common.figure(9.6, 4.2)
        left, right = fig.subplots(1, 2, width_ratios=(1.25, 1.0))
        look = looks([way.title for way in design.ways])
        _curves(left, design, look)
        _by_parameter(right, design, look)
        common.legend(fig, [left, right], look)
        yield Drawing("design", "What to measure next", _caption(design), fig)


def _curves(ax: Any, design: Design, look: Any) -> None:
    today = design.scenario.measurement.m
    for way in design.ways:
        shown = [c for c in way.curve if c.mean_bound <= _WORST]
        chosen = [choice for choice in (way.saving, way.sharpest) if choice]
        points = {c.readings: c.mean_bound for c in sorted((*shown, *chosen), key=lambda c: -c.mean_bound)}
        line = {**look[way.title].line, "markersize": 4.5, "markeredgewidth": 0.4}
        ax.plot(sorted(points), [points[readings] for readings in sorted(points)], **line)
    ax.plot(today, 1.0, marker="*", color="#C00000", markersize=13, linestyle="none", zorder=5, label="today")
    counts = [c.readings for way in design.ways for c in way.curve if c.mean_bound <= _WORST] + [today]
    across = np.geomspace(min(counts), max(counts), 30)
    same = {"color": BOUND_COLOR, "linestyle": BOUND_DASH, "linewidth": 1.0, "zorder": 1}
    ax.plot(across, np.sqrt(today / across), label="more of the same: 1 / root of the number", **same)
    ax.set_xscale("log")
    common.log_ticks(ax.xaxis, min(counts), max(counts))
    common.decades(ax, [c.mean_bound for way in design.ways for c in way.curve if c.mean_bound <= _WORST] + [1.0], 3.0)
    ax.set(xlabel="readings", ylabel="mean bound, as a share of today's")


def _by_parameter(ax: Any, design: Design, look: Any) -> None:
    names = [common.text(p.name) for p in design.observability.parameters]
    ax.axvline(1.0, color="#C00000", linewidth=1.0)
    rows = np.arange(len(names))
    for k, way in enumerate(design.ways):
        choice = way.saving or way.sharpest
        ratio = bounds_of(design, choice) / design.observability.bound
        style = {**look[way.title].line, "linestyle": "none"}
        ax.plot(ratio, rows + 0.12 * (k - (len(design.ways) - 1) / 2), **style)
    ax.set_yticks(rows, names)
    ax.invert_yaxis()
    counts = {(way.saving or way.sharpest).readings for way in design.ways}
    chosen = f"{counts.pop()} readings" if len(counts) == 1 else "what is chosen"
    ax.set(xlabel=f"bound with {chosen}, as a share of today's")


def bounds_of(design: Design, choice: Choice) -> Array:
    """Root mean square over the prior (n,) of each parameter's bound with the readings of a choice."""
    model = design.measurement(choice)
    R = design.scenario.noise.covariance(model.m)
    return Observability.at(model, R, truths_of(design.scenario, len(design.observability.singular_values))).bound


def _caption(design: Design) -> str:
    best = design.best
    assert best is not None
    scenario, today = design.scenario, design.scenario.measurement.m
    few = best.saving
    saved = (
        f"{few.readings} readings, chosen {best.title}, are worth as much as today's {today}"
        if few
        else f"no choice of fewer readings is worth as much as today's {today}"
    )
    return common.sentence(
        f"Mean bound of the parameters against the number of readings at error scale {plain(scenario.error_scale)}:"
        f" {saved}; {best.sharpest.readings} readings {best.title} reach {best.sharpest.mean_bound:.2f} of its bound.",
        "The right panel has each parameter's bound with the fewest readings that are as good as today's on average, or"
        " with the best choice where that takes as many.",
        f"{scenario.measurement.name}, {scenario.noise.name}.",
    )
