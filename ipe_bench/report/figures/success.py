"""Share of successes against error scale."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import Look
from ipe_bench.report.words import percent
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    rows = analysis.summary[analysis.summary["parameter"] == ALL] if len(analysis.summary) else analysis.summary
    for setting in common.settings(rows, analysis.setting_columns):
        there = {label: one for label, one in look.items() if label in set(setting.rows["estimator"])}
        fig, axes = common.panels(2, height=3.0, extra=0.3 + 0.2 * len(there) / 5)
        for ax, column, title in zip(
            axes, ("success", "solved"), ("success: inside the gate", "solved: the right root"), strict=True
        ):
            for label, mine in common.by_estimator(setting.rows, there):
                if column == "solved" and label not in analysis.with_equation:
                    continue
                x = mine["error_scale"] * common.dodge(there, label, setting.scales)
                if column == "success":
                    low, high = mine["success_low"], mine["success_high"]
                else:
                    low = high = mine["solved"]
                common.curve(ax, x, mine[column], low, high, there[label], label)
            common.scale_axis(ax, setting.scales)
            ax.set_ylim(-0.03, 1.03)
            ax.yaxis.set_major_formatter(lambda v, _: f"{100 * v:.0f} %")
            ax.set_ylabel("share of all trials")
            ax.set_title(title)
        common.legend_below(fig, axes)
        top = setting.rows[setting.rows["error_scale"] == max(setting.scales)].sort_values("success", ascending=False)
        seen = [f"{e} {percent(v)}" for e, v in zip(top["estimator"], top["success"], strict=True)]
        caption = (
            "Left: share of trials whose error lies inside the chi-square gate of the bound's ellipsoid, with"
            " Clopper-Pearson 95 % intervals. Right: share that ended at the root belonging to the truth, of those that"
            " solve an equation. At scale"
            f" {common.plain(max(setting.scales))} succeed: {common.enumerate_few(seen, 20)}. {setting.label}."
        )
        yield Drawing(f"success_against_scale{setting.suffix}", "Success against error scale", caption, fig)
