"""The picture of a design: the bound against the number of readings, and each parameter's bound with what is chosen."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, looks
from ipe_bench.report.words import plain
from ipe_bench.trials.design import Choice, Design
from ipe_bench.trials.observability import Observability, truths_of

_WORST = 10.0
"""Bounds above this many times today's are off the picture."""
_TODAY = "#C00000"


def draw_design(design: Design) -> Iterator[Drawing]:
    """One figure; nothing where there is nothing to choose."""
    if not design.ways:
        return
    fig = common.figure(9.6, 4.2)
    left, right = fig.subplots(1, 2, width_ratios=(1.25, 1.0))
    look, today = looks([way.title for way in design.ways]), design.scenario.measurement.m
    shown = [c for way in design.ways for c in way.curve if c.mean_bound <= _WORST]
    counts = [today, *(c.readings for c in shown)]
    rows, offset = np.arange(len(design.observability.parameters)), (len(design.ways) - 1) / 2
    for k, way in enumerate(design.ways):
        chosen = [choice for choice in (way.saving, way.sharpest) if choice]
        curve = [*(c for c in way.curve if c.mean_bound <= _WORST), *chosen]
        least = {c.readings: c.mean_bound for c in sorted(curve, key=lambda c: -c.mean_bound)}
        left.plot(sorted(least), [least[readings] for readings in sorted(least)], **look[way.title].line)
        ratio = bounds_of(design, chosen[0]) / design.observability.bound
        right.plot(ratio, rows + 0.12 * (k - offset), **look[way.title].line | {"linestyle": "none"})
    left.plot(today, 1.0, marker="*", color=_TODAY, markersize=13, linestyle="none", zorder=5, label="today")
    across = np.geomspace(min(counts), max(counts), 30)
    same = {"color": BOUND_COLOR, "linestyle": BOUND_DASH, "linewidth": 1.0, "zorder": 1}
    left.plot(across, np.sqrt(today / across), label="more of the same: 1 / root of the number", **same)
    left.set_xscale("log")
    common.log_ticks(left.xaxis, min(counts), max(counts))
    common.decades(left, [1.0, *(c.mean_bound for c in shown)], 3.0)
    left.set(xlabel="readings", ylabel="mean bound, as a share of today's")
    right.axvline(1.0, color=_TODAY, linewidth=1.0, zorder=1)
    right.set_yticks(rows, [common.text(p.name) for p in design.observability.parameters])
    right.invert_yaxis()
    numbers = {(way.saving or way.sharpest).readings for way in design.ways}
    chosen_words = f"{numbers.pop()} readings" if len(numbers) == 1 else "what is chosen"
    right.set(xlabel=f"bound with {chosen_words}, as a share of today's")
    common.legend(fig, [left, right], look)
    yield Drawing("design", "What to measure next", _caption(design), fig)


def bounds_of(design: Design, choice: Choice) -> Array:
    """Root mean square over the prior (n,) of each parameter's bound with the readings of a choice."""
    model = design.measurement(choice)
    R = design.scenario.noise.covariance(model.m)
    return Observability.at(model, R, truths_of(design.scenario, len(design.observability.singular_values))).bound


def _caption(design: Design) -> str:
    best, scenario, today = design.best, design.scenario, design.scenario.measurement.m
    assert best is not None
    saved = (
        f"{best.saving.readings} readings, chosen {best.title}, are worth as much as today's {today}"
        if best.saving
        else f"no choice of fewer readings is worth as much as today's {today}"
    )
    return common.sentence(
        f"Mean bound of the parameters against the number of readings at error scale {plain(scenario.error_scale)}:"
        f" {saved}; {best.sharpest.readings} readings {best.title} reach {best.sharpest.mean_bound:.2f} of its bound.",
        "The right panel has each parameter's bound with the fewest readings that are as good as today's on average, or"
        " with the best choice where that takes as many.",
        f"{scenario.measurement.name}, {scenario.noise.name}.",
    )
