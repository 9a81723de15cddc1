"""Estimation error against error scale: figures 2 and 3 of the paper, and the same for all estimators."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import Drawing, common
from ipe_bench.report.style import BOUND_COLOR, COLORS, DASHES, MARKERS, REFERENCE, Look
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    columns = analysis.setting_columns
    footers = {g.columns["measurement"]: g.footer for g in analysis.collection.groups}
    for suffix, setting, rows in common.settings(analysis.summary, columns):
        parameters = footers[rows["measurement"].iloc[0]]["parameters"]
        there = set(rows["estimator"])
        if REFERENCE in there:
            yield _paper_figure("figure_2", 2, REFERENCE, suffix, setting, rows, parameters)
        iterated = next((e for e in ("fixed_point", "newton") if e in there), None)
        iterated = iterated or _first_iterated(analysis, there)
        if iterated:
            yield _paper_figure("figure_3", 3, iterated, suffix, setting, rows, parameters)
    for suffix, setting, rows in common.settings(analysis.by_group, columns):
        yield _all_estimators(suffix, setting, rows, look)


def _first_iterated(analysis: Analysis, there: set[str]) -> str | None:
    frozen = [g.estimator for g in analysis.collection.groups if g.footer["equation"] == "frozen"]
    return next((e for e in frozen if e in there), None)


def _paper_figure(
    name: str, number: int, estimator: str, suffix: str, setting: str, rows: pd.DataFrame, parameters: Any
) -> Drawing:
    """The paper's figure: a panel per group of parameters in Table 1 units, and one of all in units of the bound."""
    rows = rows[rows["estimator"] == estimator]
    sizes = {p["name"]: float(p["size"]) for p in parameters}
    members: dict[str, list[Any]] = {}
    for p in parameters:
        members.setdefault(p.get("group") or p["name"], []).append(p)
    if len(members) > 11:
        members = {"all parameters": list(parameters)}
    scales = sorted(rows["error_scale"].unique())
    across = min(3, len(members) + 1)
    down = -(-(len(members) + 1) // across)
    fig = common.figure(9.2 if across == 3 else 4.2 * across, 2.75 * down + 0.2)
    axes: list[Axes] = list(fig.subplots(down, across, squeeze=False).flat)
    panels = dict(zip(members, axes, strict=False))
    values = [rows.loc[rows["parameter"] == p["name"]] for p in parameters]
    ends = np.array(
        [
            v[c].to_numpy() / sizes[p["name"]]
            for v, p in zip(values, parameters, strict=True)
            for c in ("rmse_low", "rmse_high", "linear_bound")
        ]
    )
    ends = ends[np.isfinite(ends) & (ends > 0)]
    for group, ax in panels.items():
        for i, p in enumerate(members[group]):
            mine = rows[rows["parameter"] == p["name"]].sort_values("error_scale")
            unit = sizes[p["name"]]
            look = Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)], DASHES[0])
            low, high = mine["rmse_low"] / unit, mine["rmse_high"] / unit
            common.curve(ax, mine["error_scale"], mine["rmse"] / unit, low, high, look, p["name"])
            ax.plot(
                mine["error_scale"], mine["linear_bound"] / unit, color=look.color, linestyle=(0, (2, 2)), linewidth=1.0
            )
        common.scale_axis(ax, scales)
        if len(ends):
            common.decades(ax, ends.min(), ends.max())
        first = members[group][0]
        size = f"{common.plain(sizes[first['name']])} {first['unit']}".strip()
        alike = len({(p["unit"], float(p["size"])) for p in members[group]}) == 1
        ax.set_title(common.text(group))
        ax.set_ylabel(common.text(f"rms error [{size}]" if alike else "rms error [sizes]"))
        ax.legend(loc="best", ncols=2 if len(members[group]) > 2 else 1)
    last = axes[len(members)]
    for p in parameters:
        mine = rows[rows["parameter"] == p["name"]].sort_values("error_scale")
        last.plot(mine["error_scale"], mine["rmse_over_linear_bound"], color="#aaaaaa", linewidth=0.8)
    mine = rows[rows["parameter"] == ALL].sort_values("error_scale")
    common.curve(
        last, mine["error_scale"], mine["rmse"], mine["rmse_low"], mine["rmse_high"], Look("#000000", "o", "-"), "all"
    )
    last.axhline(1.0, color=BOUND_COLOR, linestyle=(0, (2, 2)), linewidth=1.0, label="linear bound")
    common.scale_axis(last, scales)
    spread = rows["rmse_over_linear_bound"].to_numpy()
    spread = np.append(spread[np.isfinite(spread) & (spread > 0)], 1.0)
    common.decades(last, spread.min(), spread.max())
    last.set_title("all parameters over their bounds")
    last.set_ylabel("rms error / linear bound")
    last.legend(loc="best")
    for ax in axes[len(members) + 1 :]:
        ax.set_axis_off()
    for ax in axes[: len(members) + 1]:
        ax.set_xlabel("error scale")
    when = "before iteration" if estimator == REFERENCE else "after iteration"
    over = mine["rmse"].to_numpy()
    seen = "; ".join(f"{v:.3g} at scale {common.plain(s)}" for s, v in zip(mine["error_scale"], over, strict=True))
    caption = (
        f"Root mean square error of {estimator} per parameter, in multiples of the unit inputs of Table 1, with 95 %"
        f" bootstrap intervals; dashed: the linear bound, eq. (5). Last panel: error over bound, each parameter in grey"
        f" and their root mean square in black: {seen}. {setting}."
    )
    return Drawing(f"{name}{suffix}", f"Figure {number} of the paper: error {when} ({estimator})", caption, fig)


def _all_estimators(suffix: str, setting: str, rows: pd.DataFrame, look: Mapping[str, Look]) -> Drawing:
    names = list(dict.fromkeys(rows["group"]))
    if len(names) > 12:
        names = names[:12]
    across = min(3, len(names))
    down = -(-len(names) // across)
    fig = common.figure(9.2 if across == 3 else 4.4 * across, 2.6 * down + 0.8)
    axes: list[Axes] = list(fig.subplots(down, across, squeeze=False).flat)
    ends = rows[["low", "high"]].to_numpy()
    ends = np.append(ends[np.isfinite(ends) & (ends > 0)], 1.0)
    for name, ax in zip(names, axes, strict=False):
        for label, mine in common.by_estimator(rows[rows["group"] == name], look):
            common.curve(ax, mine["error_scale"], mine["rmse"], mine["low"], mine["high"], look[label], label)
        ax.axhline(1.0, color=BOUND_COLOR, linestyle=(0, (2, 2)), linewidth=1.0, label="linear bound")
        common.scale_axis(ax, rows["error_scale"].unique())
        common.decades(ax, ends.min(), ends.max())
        ax.set_title(common.text(name))
        ax.set_xlabel("error scale")
        ax.set_ylabel("rms error / linear bound")
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    common.legend_below(fig, axes[:1])
    top = rows[rows["error_scale"] == rows["error_scale"].max()].groupby("estimator", sort=False)["rmse"].max()
    seen = ", ".join(f"{label} {value:.3g}" for label, value in top.items() if np.isfinite(value))
    caption = (
        "Root mean square error over the linear bound, per group of parameters, over the trials that each estimator"
        f" solved, with 95 % bootstrap intervals. Worst group at the largest scale: {seen or 'none solved'}. {setting}."
    )
    return Drawing(f"error_against_scale{suffix}", "Error against error scale, all estimators", caption, fig)
