"""Estimation error against error scale: figures 2 and 3 of the paper, and the same for all estimators."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.common import Setting
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import COLORS, DASHES, MARKERS, REFERENCE, Look
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL

NEAR = 2.0
"""The last panel shows errors up to this multiple of the bound."""


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    parameters = {g.columns["measurement"]: g.footer["parameters"] for g in analysis.collection.groups}
    equations = {g.estimator: g.footer["equation"] for g in analysis.collection.groups}
    for setting in common.settings(analysis.summary, analysis.setting_columns):
        mine = parameters[setting.rows["measurement"].iloc[0]]
        there = [e for e in look if e in set(setting.rows["estimator"])]
        if REFERENCE in there:
            yield _paper_figure("figure_2", 2, REFERENCE, setting, mine)
        frozen = [e for e in there if equations[e] == "frozen"]
        iterated = next((e for e in ("fixed_point", "newton", *frozen) if e in there), None)
        if iterated:
            yield _paper_figure("figure_3", 3, iterated, setting, mine)
    totals = common.settings(analysis.summary[analysis.summary["parameter"] == ALL], analysis.setting_columns)
    for setting, total in zip(common.settings(analysis.by_group, analysis.setting_columns), totals, strict=True):
        yield _all_estimators(setting, total, look)


def _paper_figure(name: str, number: int, estimator: str, setting: Setting, parameters: Sequence[Any]) -> Drawing:
    """The paper's figure: a panel per group of parameters in Table 1 units, and one of all in units of the bound."""
    rows = setting.rows[setting.rows["estimator"] == estimator]
    members: dict[str, list[Any]] = {}
    for p in parameters:
        members.setdefault(p.get("group") or p["name"], []).append(p)
    if len(members) > 11:
        members = {"all parameters": list(parameters)}
    fig, axes = common.panels(len(members) + 1, extra=0.1)
    by_name = {p["name"]: rows[rows["parameter"] == p["name"]].sort_values("error_scale") for p in parameters}
    ends = [
        by_name[p["name"]][c].to_numpy() / float(p["size"])
        for p in parameters
        for c in ("rmse_low", "rmse_high", "linear_bound")
    ]
    for (group, inside), ax in zip(members.items(), axes, strict=False):
        for i, p in enumerate(inside):
            mine, unit = by_name[p["name"]], float(p["size"])
            look = Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)], DASHES[0])
            low, high = mine["rmse_low"] / unit, mine["rmse_high"] / unit
            common.curve(ax, mine["error_scale"], mine["rmse"] / unit, low, high, look, p["name"])
            bound = mine["linear_bound"] / unit
            ax.plot(mine["error_scale"], bound, color=look.color, linestyle=(0, (2, 2)), linewidth=1.0)
        common.scale_axis(ax, setting.scales)
        common.decades(ax, np.concatenate(ends))
        ax.set_title(common.text(group))
        sizes = {f"{common.plain(float(p['size']))} {p['unit']}".strip() for p in inside}
        ax.set_ylabel(common.text(f"rms error [{sizes.pop()}]" if len(sizes) == 1 else "rms error [unit inputs]"))
        if len(inside) <= 8:
            ax.legend(loc="best", ncols=2 if len(inside) > 2 else 1)
    last = axes[len(members)]
    for i, p in enumerate(parameters):
        mine = by_name[p["name"]]
        label = "each parameter" if i == 0 else None
        last.plot(mine["error_scale"], mine["rmse_over_linear_bound"], color="#aaaaaa", linewidth=0.8, label=label)
    mine = rows[rows["parameter"] == ALL].sort_values("error_scale")
    together = Look("#000000", "o", "-")
    common.curve(last, mine["error_scale"], mine["rmse"], mine["rmse_low"], mine["rmse_high"], together, "all together")
    common.bound_line(last, 1.0, "linear bound")
    common.scale_axis(last, setting.scales)
    common.decades(last, np.append(rows["rmse_over_linear_bound"], 1.0))
    last.set_title("over the linear bounds")
    last.set_ylabel("rms error / linear bound")
    last.legend(loc="best")
    when = "before iteration" if estimator == REFERENCE else "after iteration"
    seen = "; ".join(
        f"{v:.3g} at scale {common.plain(s)}" for s, v in zip(mine["error_scale"], mine["rmse"], strict=True)
    )
    caption = (
        f"Root mean square error of {estimator} per parameter over the trials that it solved, in multiples of the unit"
        " inputs (Table 1 of the paper), with 95 % bootstrap intervals; dashed: the linear bound, eq. (5). Last panel:"
        f" the same over the bounds; all parameters together are at {seen}. {setting.label}."
    )
    return Drawing(f"{name}{setting.suffix}", f"The paper's figure {number}, error {when} ({estimator})", caption, fig)


def _all_estimators(setting: Setting, total: Setting, look: Mapping[str, Look]) -> Drawing:
    rows = setting.rows
    look = {label: one for label, one in look.items() if label in set(rows["estimator"])}
    names = list(dict.fromkeys(rows["group"]))
    # One group alone, or too many to show, are shown by all parameters together.
    shown = names if 2 <= len(names) <= 8 else [ALL]
    fig, axes = common.panels(len(shown) + 1, extra=0.4 + 0.2 * (len(look) / 5))
    ends = np.concatenate([rows[["low", "high"]].to_numpy().ravel(), total.rows["rmse_high"].to_numpy(), [1.0]])
    for name, ax in zip(shown, axes, strict=False):
        part = rows[rows["group"] == name]
        if name == ALL:
            part = total.rows.rename(columns={"rmse_low": "low", "rmse_high": "high"})
        for label, mine in common.by_estimator(part, look):
            x = mine["error_scale"] * common.dodge(look, label, setting.scales)
            common.curve(ax, x, mine["rmse"], mine["low"], mine["high"], look[label], label)
        common.decades(ax, ends)
        ax.set_title("all parameters" if name == ALL else common.text(name))
    near = axes[-1]
    for label, mine in common.by_estimator(total.rows, look):
        x = mine["error_scale"] * common.dodge(look, label, setting.scales)
        y = mine["rmse"].to_numpy()
        y = np.where(y <= NEAR, y, np.nan)
        common.curve(near, x, y, mine["rmse_low"], mine["rmse_high"], look[label], label)
    near.set_title(f"all parameters, up to {common.plain(NEAR)} bounds")
    highs = total.rows["rmse_high"].to_numpy()
    highs = highs[np.isfinite(highs) & (total.rows["rmse"].to_numpy() <= NEAR)]
    near.set_ylim(0.9, max(1.15, min(NEAR, 1.03 * highs.max(initial=1.0))))
    for ax in axes:
        common.bound_line(ax, 1.0, "linear bound")
        common.scale_axis(ax, setting.scales)
        ax.set_ylabel("rms error / linear bound")
    common.legend_below(fig, axes)
    top = total.rows[total.rows["error_scale"] == max(setting.scales)]
    seen = [f"{e} {v:.3g}" for e, v in zip(top["estimator"], top["rmse"], strict=True) if np.isfinite(v)]
    caption = (
        "Root mean square error over the linear bound, per group of parameters and over all, on the trials that each"
        " estimator solved, with 95 % bootstrap intervals; estimators are set a little apart so that equal ones show."
        f" At scale {common.plain(max(setting.scales))}: {common.enumerate_few(seen, 20) or 'nobody solved any trial'}."
        f" {setting.label}."
    )
    return Drawing(f"error_against_scale{setting.suffix}", "Error against error scale, all estimators", caption, fig)
