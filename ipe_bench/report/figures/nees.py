"""Whether estimators know how wrong they are: NEES against its limits, coverage, and the filters' NIS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, Look
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    rows = analysis.summary[analysis.summary["parameter"] == ALL] if len(analysis.summary) else analysis.summary
    rows = rows[rows["nees"].notna()]
    scores = analysis.scores
    nis_of = None
    if "extra_nis" in scores.columns and scores["extra_nis"].notna().any():
        nis_of = common.settings(scores, analysis.setting_columns)
    for setting in common.settings(rows, analysis.setting_columns):
        there = {label: one for label, one in look.items() if label in set(setting.rows["estimator"])}
        nis = None
        if nis_of is not None:
            nis = next((s.rows[s.rows["extra_nis"].notna()] for s in nis_of if s.label == setting.label), None)
            nis = nis if nis is not None and len(nis) else None
        fig, axes = common.panels(2 if nis is None else 3, height=3.0, extra=0.3 + 0.2 * len(there) / 5)
        nees, coverage = axes[:2]
        for label, mine in common.by_estimator(setting.rows, there):
            x = mine["error_scale"] * common.dodge(there, label, setting.scales)
            nees.plot(x, mine["nees"], label=common.text(label), **there[label].line)
            coverage.plot(x, mine["coverage95"], label=common.text(label), **there[label].line)
        limits = setting.rows.groupby("error_scale")[["nees_low", "nees_high"]].agg(
            {"nees_low": "min", "nees_high": "max"}
        )
        at = limits.index.to_numpy(dtype=float)
        if len(at) == 1:
            at = np.array([at[0] / 2, at[0] * 2])
            limits = pd.concat([limits, limits])
        band = {"color": BOUND_COLOR, "alpha": 0.25, "linewidth": 0, "label": "95 % limits", "zorder": 1}
        nees.fill_between(at, limits["nees_low"].to_numpy(), limits["nees_high"].to_numpy(), **band)
        common.bound_line(nees, 1.0, "honest covariance")
        common.decades(nees, np.append(setting.rows["nees"], 1.0))
        nees.set_title("NEES over n, solved trials")
        nees.set_ylabel("mean NEES / n")
        common.bound_line(coverage, 0.95, "honest covariance")
        coverage.set_ylim(-0.03, 1.03)
        coverage.yaxis.set_major_formatter(lambda v, _: f"{100 * v:.0f} %")
        coverage.set_title("truth inside the 95 % ellipsoid")
        coverage.set_ylabel("share of all trials")
        if nis is not None:
            for label, mine in common.by_estimator(nis, there):
                x = mine["error_scale"] * common.dodge(there, label, setting.scales)
                axes[2].plot(x, mine["extra_nis"], label=common.text(label), **there[label].line)
            common.bound_line(axes[2], 1.0, "honest covariance")
            common.decades(axes[2], np.append(nis["extra_nis"], 1.0))
            axes[2].set_title("NIS over readings, all trials")
            axes[2].set_ylabel("mean NIS")
        for ax in axes:
            common.scale_axis(ax, setting.scales)
        common.legend_below(fig, axes[:1])
        inside = (setting.rows["nees"] >= setting.rows["nees_low"]) & (
            setting.rows["nees"] <= setting.rows["nees_high"]
        )
        always = [e for e in there if inside[setting.rows["estimator"] == e].all()]
        caption = (
            "First panel: mean normalised estimation error squared over the number of parameters, 1 where the reported"
            " covariance is right, with the chi-square limits of the mean as a band. Second panel: how often the truth"
            " lies inside the estimator's own 95 % ellipsoid. Inside the limits at every scale:"
            f" {common.enumerate_few(always, 20) or 'nobody'}. {setting.label}."
        )
        if nis is not None:
            caption += " Third panel: the filters' innovations against the covariance that they expect of them."
        yield Drawing(f"consistency{setting.suffix}", "Consistency of the reported covariance", caption, fig)
