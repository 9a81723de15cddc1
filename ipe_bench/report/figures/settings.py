"""Settings side by side: what another noise, model or option does to each estimator, in one panel per estimator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import DASHES, looks
from ipe_bench.report.words import percent, plain

MOST_ESTIMATORS = 9


def draw(view: View) -> Iterator[Drawing]:
    if len(view.parts) < 2:
        return
    rows = pd.concat([part.totals.assign(setting=part.label) for part in view.parts], ignore_index=True)
    there = list(dict.fromkeys(rows["estimator"]))
    shown = [label for label in view.look if label in there][:MOST_ESTIMATORS]
    rows = rows[rows["estimator"].isin(shown)]
    left_out = f" {len(there) - len(shown)} further estimators are in the tables." if len(there) > len(shown) else ""
    worst = rows.sort_values("success", kind="stable").iloc[0]
    success = common.sentence(
        "Share of trials inside the gate of success with Clopper-Pearson 95 % intervals, the settings of a sweep in one"
        f" panel per estimator.{left_out}",
        common.UPON,
        f"Least: {worst['estimator']} with {percent(worst['success'])} at scale {plain(worst['error_scale'])},"
        f" {worst['setting']}.",
    )
    yield Drawing("settings_success", "Success by setting", success, _panels(view, rows, shown, "success"))
    error = common.sentence(
        "Root mean square error of the solved trials over each setting's own linear bound, all parameters, with 95 %"
        f" bootstrap intervals, the settings of a sweep in one panel per estimator.{left_out}",
        common.UPON,
    )
    yield Drawing("settings_error", "Error by setting", error, _panels(view, rows, shown, "rmse"))


def _panels(view: View, rows: pd.DataFrame, shown: list[str], column: str) -> Any:
    look = looks([part.label for part in view.parts])
    # Settings often make no difference: dashes let the line beneath be seen.
    look = {label: replace(one, dash=DASHES[i % len(DASHES)]) for i, (label, one) in enumerate(look.items())}
    fig, axes = common.panels(len(shown), look, height=2.5)
    scales = sorted({float(s) for s in rows["error_scale"]})
    for label, ax in zip(shown, axes, strict=True):
        part = rows[rows["estimator"] == label]
        if column == "success":
            common.shares(ax, "")
            interval, trials, heading = ("success_low", "success_high"), "trials", "success"
        else:
            common.decades(ax, np.append(part["rmse"], 1.0), ends=part[["rmse_low", "rmse_high"]])
            interval, trials, heading = ("rmse_low", "rmse_high"), "solved_trials", "rms error / linear bound"
        common.curves(ax, part, column, look, scales, interval=interval, by="setting", trials=trials)
        if column == "rmse":
            common.bound_line(ax, 1.0, "linear bound")
        ax.set(title=common.text(label), ylabel=heading)
    common.legend_below(fig, axes, look)
    return fig


FIGURE = Figure(draw, ("summary",), together=True)
