"""How iterates approach their limit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, Look
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.histories import CLOSE

FLOOR = 1e-10
"""Distances below this are drawn here: round-off."""


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    from matplotlib.ticker import MaxNLocator

    stored = {
        where: [rows["distance"].to_numpy() for _, rows in part.groupby("trial", sort=False)]
        for where, part in analysis.convergence.groupby(["scenario", "estimator"], sort=False)
    }
    for setting in common.settings(analysis.scores, analysis.setting_columns):
        there = {}
        for label, one in look.items():
            mine = [stored.get((setting.scenario(s), label), []) for s in setting.scales]
            # A direct estimate has a start and an end, and nothing between: there is no convergence to see.
            if any(len(d) > 2 for part in mine for d in part):
                there[label] = one
        scales = [s for s in setting.scales if any((setting.scenario(s), e) in stored for e in there)]
        scales = common.spread(scales)
        if not there or not scales:
            continue
        fig, axes = common.panels(len(scales), extra=0.4 + 0.2 * len(there) / 5)
        steps: dict[str, float] = {}
        for scale, ax in zip(scales, axes, strict=True):
            longest = 1
            for label in there:
                distances = stored.get((setting.scenario(scale), label))
                if not distances:
                    continue
                table = _padded(distances)
                middle = np.maximum(np.median(table, axis=0), FLOOR)
                low = np.maximum(table.min(axis=0), FLOOR)
                high = np.maximum(table.max(axis=0), FLOOR)
                # What follows the median's arrival is a flat line at the floor.
                end = min(len(middle), int(np.argmax(middle <= FLOOR)) + 1 if (middle <= FLOOR).any() else len(middle))
                longest = max(longest, end)
                k = np.arange(end)
                every = max(1, end // 12)
                ax.plot(k, middle[:end], label=common.text(label), markevery=every, **there[label].line)
                ax.fill_between(k, low[:end], high[:end], color=there[label].color, alpha=0.12, linewidth=0)
                if scale == scales[-1]:
                    steps[label] = float(np.median([np.sum(d > CLOSE) for d in distances]))
            common.bound_line(ax, CLOSE, f"{CLOSE:g} standard deviations")
            ax.set_yscale("log")
            ax.set_ylim(FLOOR / 3, None)
            if longest > 60:
                ax.set_xscale("symlog", linthresh=10)
            else:
                ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
            ax.set_title(f"error scale {common.plain(scale)}")
            ax.set_xlabel("iteration")
            ax.set_ylabel("distance to own limit [σ]")
            ax.axhline(FLOOR, color=BOUND_COLOR, linewidth=0.4)
        common.legend_below(fig, axes)
        seen = [f"{label} {count:g}" for label, count in steps.items()]
        caption = (
            "Largest component of an iterate's distance from the last one, in standard deviations of the Cramér-Rao"
            f" bound: median (line) and range (shade) of the first converged trials; below {FLOOR:g} it is round-off."
            f" Median iterations until within {CLOSE:g} standard deviations at scale {common.plain(scales[-1])}:"
            f" {common.enumerate_few(seen, 20)}. {setting.label}."
        )
        yield Drawing(f"convergence{setting.suffix}", "Convergence", caption, fig)


def _padded(distances: list[np.ndarray]) -> np.ndarray:
    """(trials, iterates): a trial that has arrived stays at zero."""
    table = np.zeros((len(distances), max(map(len, distances))))
    for row, values in zip(table, distances, strict=True):
        row[: len(values)] = np.where(np.isfinite(values), values, np.inf)
    table[np.isinf(table)] = np.finfo(float).max
    return table
