"""Distribution of the trials' errors, held against that of an efficient estimator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from scipy.stats import chi

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, Look
from ipe_bench.statistics.analysis import PROBABILITIES, Analysis
from ipe_bench.trials.thresholds import GATE


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    parameters = {g.columns["measurement"]: len(g.footer["parameters"]) for g in analysis.collection.groups}
    for setting in common.settings(analysis.scores, analysis.setting_columns):
        n = parameters[setting.rows["measurement"].iloc[0]]
        there = {label: one for label, one in look.items() if label in set(setting.rows["estimator"])}
        scales = common.spread(setting.scales)
        fig, axes = common.panels(len(scales), extra=0.4 + 0.2 * len(there) / 5)
        medians = {}
        for scale, ax in zip(scales, axes, strict=True):
            for label in there:
                frame = analysis.distributions
                rows = frame[(frame["scenario"] == setting.scenario(scale)) & (frame["estimator"] == label)]
                if rows.empty:
                    continue
                values = rows["distance"].to_numpy()
                medians[scale, label] = values[np.searchsorted(PROBABILITIES, 0.5)]
                shown = np.isfinite(values) & (values > 0)
                ax.plot(
                    values[shown] / np.sqrt(n),
                    PROBABILITIES[shown],
                    color=there[label].color,
                    linestyle=there[label].dash,
                    marker=there[label].marker,
                    markevery=(list(there).index(label) % 10, 25),
                    markersize=4.5,
                    markeredgecolor="white",
                    markeredgewidth=0.5,
                    linewidth=1.3,
                    label=common.text(label),
                )
            x = np.geomspace(chi.ppf(0.001, n), chi.ppf(0.9999, n), 200)
            ax.plot(
                x / np.sqrt(n), chi.cdf(x, n), color=BOUND_COLOR, lw=3.5, alpha=0.25, label="efficient (chi)", zorder=1
            )
            gate = chi.isf(GATE, n) / np.sqrt(n)
            ax.axvline(gate, color=BOUND_COLOR, linestyle=(0, (2, 2)), linewidth=1.0, label="gate of success")
            ax.set_xscale("log")
            common.log_ticks(ax.xaxis, *ax.get_xlim())
            ax.set_ylim(-0.02, 1.02)
            ax.set_title(f"error scale {common.plain(scale)}")
            ax.set_xlabel("Mahalanobis error / √n")
            ax.set_ylabel("share of trials below")
        common.legend_below(fig, axes)
        last = scales[-1]
        seen = [f"{e} {medians[last, e] / np.sqrt(n):.3g}" for e in there if (last, e) in medians]
        caption = (
            "Share of all trials whose Mahalanobis error (in standard deviations of the Cramér-Rao bound, over the root"
            " of the number of parameters) is below the abscissa; grey band: an efficient estimator; curves that end"
            " below one belong to estimators some of whose estimates are not finite. Medians at scale"
            f" {common.plain(last)}: {common.enumerate_few(seen, 20)}. {setting.label}."
        )
        yield Drawing(f"error_distributions{setting.suffix}", "Distribution of errors", caption, fig)
