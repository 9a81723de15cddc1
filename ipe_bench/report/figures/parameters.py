"""Errors parameter by parameter: figures 2 and 3 of the paper, and all estimators side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_DASH, COLORS, GREY, MARKERS, REFERENCE, Look
from ipe_bench.report.words import plain
from ipe_bench.statistics.summary import ALL

MOST_PARAMETERS, MOST_GROUPS, MOST_NUMBERED = 30, 8, 15
WORST = 100.0
"""Errors of this many bounds and more have one colour."""


def draw(view: View) -> Iterator[Drawing]:
    if view.totals.empty:
        return
    iterated = [label for label, equation in view.equations.items() if equation == "frozen" and label in view.look]
    shown = [
        label for label in (REFERENCE, *sorted(iterated, key=lambda e: e != "fixed_point")[:1]) if label in view.look
    ]
    for label in shown:
        yield _of_one(view, label)
    if 2 <= view.n <= MOST_PARAMETERS:
        yield _of_all(view)


def _of_one(view: View, estimator: str) -> Drawing:
    """A panel per group of parameters in physical units, and one of all of them over their bounds."""
    rows = view["summary"]
    rows = rows[(rows["estimator"] == estimator) & (rows["parameter"] != ALL)]
    rows = rows.assign(solved_trials=(rows["solved"] * rows["trials"]).round())
    totals = view.totals[view.totals["estimator"] == estimator].assign(parameter=ALL)
    groups = _groups(view.parameters)
    fig, axes = common.panels(len(groups) + 1, height=2.4)
    units: dict[Any, str] = {}
    for (group, inside), ax in zip(groups.items(), axes, strict=False):
        look = {p["name"]: Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]) for i, p in enumerate(inside)}
        part = rows[rows["parameter"].isin(list(look))]
        common.decades(ax, part[["rmse", "linear_bound"]], ends=part[["rmse_low", "rmse_high"]])
        _bounds(ax, part, look, view)
        _curves(ax, part, look, view)
        common.title(ax, group)
        units[ax] = f"[{inside[0]['unit']}]" if inside[0]["unit"] else ""
        if len(inside) > 1 and len(view.scales) > 1:
            common.direct_labels(ax, part, "rmse", look, "parameter")
    together = {ALL: Look("#000000", "o")}
    ratio, last = "rmse_over_linear_bound", axes[-1]
    common.decades(last, np.append(rows[ratio], [1.0, *totals["rmse"]]), ends=totals[["rmse_low", "rmse_high"]])
    each = rows.assign(rmse=rows[ratio])
    _curves(last, each, {p["name"]: Look(GREY, ",") for p in view.parameters}, view, interval=None)
    _curves(last, totals, together, view)
    common.bound_line(last, 1.0, "linear bound, eq. (5)")
    last.plot([], [], color=GREY, label="each parameter")
    common.title(last, "all parameters")
    common.axis_labels(fig, "error scale" if len(view.scales) > 1 else "", "rms error")
    for ax, unit in (units | {last: "[bounds]"}).items():
        ax.set_ylabel(common.text(unit))
    common.legend(fig, axes, {"all parameters together": together[ALL]})
    caption = common.sentence(
        f"Root mean square error of {estimator} over the trials that it solved ({_missing(totals)}), with 95 %"
        " bootstrap intervals; dotted: the linear bound. Last panel: the same over the bounds, and all together",
        f"at {_at_scales(totals, 'rmse')}. {view.label}.",
    )
    number = 2 if estimator == REFERENCE else 3
    name = f"figure_{number}" if view.paper else f"parameter_errors_{estimator}"
    of_paper = f"Figure {number} of the paper: " if view.paper else ""
    return Drawing(f"{name}{view.suffix}", f"{of_paper}error of {estimator}, solved trials", caption, fig)


def _groups(parameters: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Parameters of one group and one unit, under the name of the group."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for p in parameters:
        group = p.get("group") or p["name"]
        other = groups.get(group)
        groups.setdefault(group if not other or other[0]["unit"] == p["unit"] else f"{group} ({p['name']})", []).append(
            p
        )
    return groups if len(groups) <= MOST_GROUPS else {}


def _bounds(ax: Any, rows: pd.DataFrame, look: Mapping[str, Look], view: View) -> None:
    """Each parameter's linear bound in its colour: dotted over the scales, a level mark if there is one scale."""
    for i, (label, one) in enumerate(look.items()):
        bound = rows[rows["parameter"] == label].sort_values("error_scale")
        style = {"color": one.color, "linestyle": BOUND_DASH, "linewidth": 1.0}
        if len(view.scales) > 1:
            ax.plot(bound["error_scale"], bound["linear_bound"], **style)
        else:
            ax.hlines(bound["linear_bound"], i - 0.3, i + 0.3, **style)


def _curves(ax: Any, rows: Any, look: Any, view: View, interval: Any = ("rmse_low", "rmse_high")) -> None:
    common.curves(ax, rows, "rmse", look, view.scales, interval=interval, by="parameter", trials="solved_trials")


def _missing(totals: pd.DataFrame) -> str:
    """How many trials an estimator solved at each scale."""
    lacking = totals[totals["solved_trials"] < totals["trials"]]
    columns = (lacking[c] for c in ("solved_trials", "trials", "error_scale"))
    seen = [f"{solved:.0f} of {trials} at scale {plain(scale)}" for solved, trials, scale in zip(*columns, strict=True)]
    return common.enumerate_few(seen, 12) or f"all of {plain(float(totals['trials'].min()))}"


def _at_scales(totals: pd.DataFrame, column: str) -> str:
    pairs = zip(totals["error_scale"], totals[column], strict=True)
    return "; ".join(f"{v:.3g} at scale {plain(s)}" for s, v in pairs if np.isfinite(v)) or "no scale"


def _of_all(view: View) -> Drawing:
    """A heat map per error scale: estimators by parameters."""
    import seaborn as sns
    from matplotlib.colors import LogNorm

    scales = common.spread(view.scales, 4)
    rows = view["summary"]
    rows = rows[rows["parameter"] != ALL]
    # 1.96 deviations hold 95 % of normal errors.
    rows = rows.assign(ratio=rows["q95_abs_error"] / (1.96 * rows["crlb"]))
    names = [p["name"] for p in view.parameters]
    labels = list(view.look)
    fig = common.figure(9.6, 1.2 + (-(-len(scales) // 2)) * (0.5 + 0.2 * len(labels)))
    down, across = -(-len(scales) // 2), min(2, len(scales))
    axes = list(fig.subplots(down, across, squeeze=False, sharex=True, sharey=True).flat)
    for ax in axes[len(scales) :]:
        ax.set_axis_off()
    numbers = view.n <= MOST_NUMBERED and common.most_panels() > 4
    for scale, ax in zip(scales, axes, strict=False):
        table = common.at_scale(rows, scale).pivot_table(index="estimator", columns="parameter", values="ratio")
        table = table.reindex(index=labels, columns=names)
        shown = table.clip(lower=0.01).replace(np.inf, 1e300)
        style = {"cmap": "rocket_r", "norm": LogNorm(1.0, WORST, clip=True), "cbar": False, "linewidths": 0.5}
        cells = table.map(_short) if numbers else False
        sns.heatmap(shown, ax=ax, annot=cells, fmt="", annot_kws={"fontsize": 6.5}, **style)
        ax.set(xlabel="", ylabel="")
        ax.set_xticks(np.arange(view.n) + 0.5, [common.text(n) for n in names], rotation=90)
        ax.set_yticks(np.arange(len(labels)) + 0.5, [common.text(e) for e in labels], rotation=0)
        common.title(ax, f"error scale {plain(scale)}")
    mesh = axes[0].collections[0]
    fig.colorbar(mesh, ax=axes, label="95 % error / bound's", shrink=0.8, extend="max").outline.set_linewidth(0)
    last = common.at_scale(rows, scales[-1])
    ratios = last["ratio"].replace(np.inf, np.nan).to_numpy(dtype=float)
    worst = last.iloc[int(np.nanargmax(ratios))] if np.isfinite(ratios).any() else None
    caption = common.sentence(
        "What 95 % of all trials err by at most in each parameter, over 1.96 deviations of its Cramér-Rao bound: 1 for"
        f" an efficient estimator; one colour from {plain(WORST)} on.",
        ""
        if worst is None
        else f"Largest at scale {plain(scales[-1])}: {worst['parameter']} by {worst['estimator']},"
        f" {worst['ratio']:.3g}.",
        f"{view.label}.",
    )
    return Drawing(f"error_by_parameter{view.suffix}", "Error by parameter, all trials", caption, fig)


def _short(value: float) -> str:
    if not np.isfinite(value):
        return "∞" if value > 0 else ""
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}" if value < 999.5 else common.power_of_ten(value)


FIGURE = Figure(draw, ("summary",))
