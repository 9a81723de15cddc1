"""Settings side by side: what another noise, model or option does to each estimator, in one panel per estimator."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import looks
from ipe_bench.report.words import percent, plain


def draw(view: View) -> Iterator[Drawing]:
    if len(view.parts) < 2:
        return
    rows = pd.concat([part.totals.assign(setting=part.label) for part in view.parts], ignore_index=True)
    there = [label for label in view.look if label in set(rows["estimator"])]
    shown = there[: common.most_panels() + 3 * (common.most_panels() > 4)]
    left_out = f"{len(there) - len(shown)} further estimators are in the tables." if len(there) > len(shown) else ""
    rows = rows[rows["estimator"].isin(shown)]
    worst = rows.sort_values("success", kind="stable").iloc[0]
    scales = sorted({float(s) for s in rows["error_scale"]})
    look = looks([part.label for part in view.parts])
    captions = {
        "success": (
            "Share of trials inside the gate of success with Clopper-Pearson 95 % intervals, the settings of a sweep in"
            " one panel per estimator.",
            f"Least: {worst['estimator']} with {percent(worst['success'])} at scale {plain(worst['error_scale'])},"
            f" {worst['setting']}.",
        ),
        "error": (
            "What 95 % of all trials err by at most, as root mean square over the parameters of error over each"
            " setting's own linear bound, in one panel per estimator.",
        ),
    }
    for kind, words in captions.items():
        fig, axes = common.panels(len(shown), look, height=2.5)
        for label, ax in zip(shown, axes, strict=True):
            part = rows[rows["estimator"] == label]
            if kind == "success":
                common.shares(ax, "")
                common.curves(ax, part, kind, look, scales, interval=("success_low", "success_high"), by="setting")
            else:
                common.decades(ax, np.append(part["q95_abs_error"], 1.0))
                common.curves(ax, part, "q95_abs_error", look, scales, by="setting")
                common.bound_line(ax, 1.0, "linear bound")
            common.title(ax, label)
        heading = "success" if kind == "success" else "95 % error / linear bound"
        common.axis_labels(fig, "error scale" if len(scales) > 1 else "", heading)
        common.legend(fig, axes, look)
        title = f"{kind.capitalize()} by setting, all trials"
        yield Drawing(f"settings_{kind}", title, common.sentence(*words, left_out), fig)


FIGURE = Figure(draw, ("summary",), together=True)
