"""Cost against accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import Look
from ipe_bench.statistics.analysis import Analysis


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    parameters = {g.columns["measurement"]: len(g.footer["parameters"]) for g in analysis.collection.groups}
    for setting in common.settings(analysis.scores, analysis.setting_columns):
        n = parameters[setting.rows["measurement"].iloc[0]]
        root_n = math.sqrt(n)
        there = {label: one for label, one in look.items() if label in set(setting.rows["estimator"])}
        scales = common.spread(setting.scales)
        fig, axes = common.panels(len(scales), extra=0.4 + 0.2 * len(there) / 5)
        cheapest = ""
        for scale, ax in zip(scales, axes, strict=True):
            at = setting.rows[setting.rows["error_scale"] == scale]
            for label, mine in common.by_estimator(at, there):
                ax.plot(
                    np.maximum(mine["cost_median"], 0.5),
                    mine["capped_error"] / root_n,
                    linestyle="none",
                    marker=there[label].marker,
                    color=there[label].color,
                    markersize=8,
                    markeredgecolor="white",
                    markeredgewidth=0.7,
                    label=common.text(label),
                )
            # What an efficient estimator's mean error is: the mean of a chi distribution with n degrees.
            efficient = math.sqrt(2) * math.exp(math.lgamma((n + 1) / 2) - math.lgamma(n / 2)) / root_n
            common.bound_line(ax, efficient, "efficient")
            ax.set_xscale("log")
            costs = np.maximum(setting.rows["cost_median"].to_numpy(dtype=float), 0.5)
            costs = costs[np.isfinite(costs)]
            if len(costs):
                ax.set_xlim(costs.min() / 1.8, costs.max() * 1.8)
            common.log_ticks(ax.xaxis, *ax.get_xlim())
            top = float(np.nanmax(setting.rows["capped_error"] / root_n))
            ax.set_ylim(min(0.8, float(np.nanmin(setting.rows["capped_error"] / root_n)) * 0.9), top * 1.08)
            ax.set_title(f"error scale {common.plain(scale)}")
            ax.set_xlabel("simulations per trial (median)")
            ax.set_ylabel("mean error / √n, capped")
            good = at[at["capped_error"] <= at["capped_error"].min() * 1.05]
            if len(good):
                row = good.iloc[int(np.argmin(good["cost_median"].to_numpy()))]
                cheapest = f"{row['estimator']} ({row['cost_median']:g} simulations)"
        common.legend_below(fig, axes)
        caption = (
            "Median cost of a trial in simulations, a Jacobian counting as many as there are parameters, against the"
            " mean Mahalanobis error over √n, each trial's capped at the gate of success; down and left is better. The"
            f" cheapest within 5 % of the best error at scale {common.plain(scales[-1])}: {cheapest}. {setting.label}."
        )
        yield Drawing(f"cost_against_accuracy{setting.suffix}", "Cost against accuracy", caption, fig)
