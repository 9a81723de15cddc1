"""Estimation error against error scale: figures 2 and 3 of the paper, and the same for all estimators."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_DASH, COLORS, MARKERS, REFERENCE, Look
from ipe_bench.report.words import plain
from ipe_bench.statistics.summary import ALL

TOGETHER = "all parameters together"
_TOGETHER = Look("#000000", "o")
NEAR = 2.0
"""The panel of efficiency shows errors up to this multiple of the bound."""
MOST_GROUPS = 8
"""Groups of parameters that have a panel each; more are shown by all parameters together."""


def draw(view: View) -> Iterator[Drawing]:
    if view.totals.empty:
        return
    if REFERENCE in view.look:
        yield _paper_figure(view, 2, REFERENCE)
    frozen = [label for label, equation in view.equations.items() if equation == "frozen"]
    iterated = next((e for e in ("fixed_point", "newton", *frozen) if e in view.look), None)
    if iterated:
        yield _paper_figure(view, 3, iterated)
    yield _all_estimators(view)


def _paper_figure(view: View, number: int, estimator: str) -> Drawing:
    """The paper's figure: a panel per group of parameters in Table 1 units, and one of all in units of the bound."""
    totals = view.totals[view.totals["estimator"] == estimator]
    rows = _in_units(view, estimator)
    groups = _groups(view.parameters)
    fig, axes = common.panels(len(groups) + 1)
    for (group, inside), ax in zip(groups.items(), axes, strict=False):
        look = {p["name"]: Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]) for i, p in enumerate(inside)}
        common.decades(ax, rows[["rmse", "linear_bound"]], ends=rows[["rmse_low", "rmse_high"]])
        _bounds(ax, rows, look, view)
        common.curves(ax, rows, "rmse", look, view.scales, interval=("rmse_low", "rmse_high"), by="parameter")
        sizes = {f"{plain(float(p['size']))} {p['unit']}".strip() for p in inside}
        ax.set_ylabel(common.text(f"rms error [{sizes.pop()}]" if len(sizes) == 1 else "rms error [unit inputs]"))
        ax.set_title(common.text(group))
        if len(inside) > 1 and len(view.scales) > 1:
            lines = {common.text(name): _handle(one) for name, one in look.items()}
            ax.legend(list(lines.values()), list(lines), loc="best", ncols=2 if len(inside) > 2 else 1)
        elif len(inside) == 1:
            ax.set_title(common.text(group if group == inside[0]["name"] else f"{group} ({inside[0]['name']})"))
    _over_bounds(axes[-1], rows, totals, view)
    common.legend_below(fig, axes, {TOGETHER: _TOGETHER})
    when = "before iteration" if estimator == REFERENCE else "after iteration"
    seen = _at_scales(totals, "rmse")
    caption = common.sentence(
        f"Root mean square error of {estimator} per parameter over the trials that it solved ({_missing(totals)}), in"
        " multiples of the unit inputs (Table 1 of the paper), with 95 % bootstrap intervals; dotted: the linear bound,"
        " eq. (5). Last panel: the same over the bounds, and all parameters together",
        f"at {seen}. {view.label}.",
    )
    name = f"figure_{number}{view.suffix}"
    return Drawing(name, f"The paper's figure {number}, error {when} ({estimator})", caption, fig)


def _in_units(view: View, estimator: str) -> pd.DataFrame:
    """An estimator's rows of each parameter, in multiples of its unit input."""
    rows = view["summary"]
    rows = rows[(rows["estimator"] == estimator) & (rows["parameter"] != ALL)]
    sizes = rows["parameter"].map({p["name"]: float(p["size"]) for p in view.parameters}).to_numpy()
    units = {c: rows[c] / sizes for c in ("rmse", "rmse_low", "rmse_high", "linear_bound")}
    return rows.assign(**units, solved_trials=(rows["solved"] * rows["trials"]).round())


def _groups(parameters: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for p in parameters:
        groups.setdefault(p.get("group") or p["name"], []).append(p)
    return groups if len(groups) <= 11 else {"all parameters": list(parameters)}


def _bounds(ax: Any, rows: pd.DataFrame, look: Mapping[str, Look], view: View) -> None:
    """Each parameter's linear bound in its colour: dotted over the scales, a level mark where there is one scale."""
    for i, (label, one) in enumerate(look.items()):
        bound = rows[rows["parameter"] == label].sort_values("error_scale")
        if len(view.scales) > 1:
            ax.plot(bound["error_scale"], bound["linear_bound"], color=one.color, linestyle=BOUND_DASH, linewidth=1.0)
        else:
            ax.hlines(bound["linear_bound"], i - 0.3, i + 0.3, color=one.color, linestyle=BOUND_DASH, linewidth=1.0)


def _over_bounds(ax: Any, rows: pd.DataFrame, totals: pd.DataFrame, view: View) -> None:
    ratio = "rmse_over_linear_bound"
    together = {"together": _TOGETHER}
    common.decades(ax, np.append(rows[ratio], [1.0, *totals["rmse"]]), ends=totals[["rmse_low", "rmse_high"]])
    if len(view.scales) > 1:
        table = rows.pivot_table(index="error_scale", columns="parameter", values=ratio)
        lines = ax.plot(table.index, table, color="#aaaaaa", linewidth=0.8)
    else:
        lines = ax.plot(np.zeros(len(rows)), rows[ratio], "_", color="#aaaaaa")
    lines[0].set_label("each parameter")
    interval = ("rmse_low", "rmse_high")
    totals = totals.assign(parameter="together")
    common.curves(ax, totals, "rmse", together, view.scales, interval=interval, by="parameter")
    common.bound_line(ax, 1.0, "bound")
    _mark_missing(ax, totals, view)
    ax.set(title="over the linear bounds", ylabel="rms error / linear bound")


def _mark_missing(ax: Any, totals: pd.DataFrame, view: View) -> None:
    """Writes how many trials are behind the points of one estimator, wherever some are missing."""
    lacking = totals[totals["solved_trials"] < totals["trials"]]
    for scale, value, solved, trials in zip(
        lacking["error_scale"], lacking["rmse"], lacking["solved_trials"], lacking["trials"], strict=True
    ):
        if not np.isfinite(value):
            continue
        x = scale if len(view.scales) > 1 else 0.0
        note = f"{solved:.0f} of {trials}"
        ax.annotate(note, (x, value), xytext=(-4, 5), textcoords="offset points", ha="right", fontsize=6.5)


def _all_estimators(view: View) -> Drawing:
    totals, look = view.totals, view.look
    counts = totals[["error_scale", "estimator", "trials", "solved_trials"]]
    by_group = view["by_group"].merge(counts, on=["error_scale", "estimator"])
    names = list(dict.fromkeys(by_group["group"]))
    together = totals.assign(group=ALL, low=totals["rmse_low"], high=totals["rmse_high"])
    if 2 <= len(names) <= MOST_GROUPS:
        shown = by_group
    else:
        # One group alone, or too many to show, are shown by all parameters together.
        shown, names = together, [ALL]
    lacking = bool((totals["solved_trials"] < totals["trials"]).any())
    fig, axes = common.panels(len(names) + 1 + lacking, look)
    points = np.concatenate([shown["rmse"], totals["crlb"], [1.0]])
    for name, ax in zip(names, axes, strict=False):
        common.decades(ax, points, ends=shown[["low", "high"]])
        rows = shown[shown["group"] == name]
        common.curves(ax, rows, "rmse", look, view.scales, interval=("low", "high"))
        common.bound_line(ax, 1.0, "bound")
        ax.set_title("all parameters" if name == ALL else common.text(name))
        ax.set_ylabel("rms error / linear bound")
    efficiency = axes[len(names)]
    _efficiency(efficiency, totals, look, view)
    if lacking:
        common.shares(axes[-1], "")
        common.curves(axes[-1], totals, "solved", look, view.scales, trials="trials")
        common.shares(axes[-1], f"share of {_trials(totals)} trials")
        axes[-1].set_title("trials behind the points")
    common.legend_below(fig, axes, look)
    top = common.at_scale(totals, view.scales[-1])
    seen = common.values_of(top, "rmse") or "nobody solved any trial"
    caption = common.sentence(
        "Root mean square error over the linear bound, per group of parameters and over all, on the trials that each"
        " estimator solved, with 95 % bootstrap intervals, cut where they leave a panel. Efficiency: over the bound"
        f" that applies at that scale, as far as {plain(NEAR)}.",
        "Last panel: the share of trials that the others are over." if lacking else "All trials were solved.",
        common.UPON,
        f"At scale {plain(view.scales[-1])}: {seen}. {view.label}.",
    )
    name = f"error_against_scale{view.suffix}"
    title = "Error against error scale" if len(view.scales) > 1 else f"Error at error scale {plain(view.scales[0])}"
    return Drawing(name, f"{title}, all estimators", caption, fig)


def _efficiency(ax: Any, totals: pd.DataFrame, look: Mapping[str, Look], view: View) -> None:
    """Errors over the bound at the truth, where they are near it."""
    ratio = 1 / totals["efficiency"]
    per_bound = ratio / totals["rmse"]
    rows = totals.assign(
        ratio=ratio.where(ratio <= NEAR), low=totals["rmse_low"] * per_bound, high=totals["rmse_high"] * per_bound
    )
    highs = rows["high"].where(rows["ratio"].notna() & np.isfinite(rows["high"]))
    low, high = np.nanmin([0.9, *rows["ratio"]]), min(np.nanmax([1.1, *rows["ratio"], *highs]), NEAR)
    ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
    common.curves(ax, rows, "ratio", look, view.scales, interval=("low", "high"))
    common.bound_line(ax, 1.0, "bound")
    ax.set(title=f"all parameters, up to {plain(NEAR)} bounds", ylabel="rms error / bound at that scale")


def _handle(look: Look) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], **look.line)


def _trials(totals: pd.DataFrame) -> str:
    counts = sorted(set(totals["trials"]))
    return plain(counts[0]) if len(counts) == 1 else f"{plain(counts[0])} to {plain(counts[-1])}"


def _missing(totals: pd.DataFrame) -> str:
    """How many trials an estimator solved, where it did not solve all."""
    lacking = totals[totals["solved_trials"] < totals["trials"]]
    seen = [
        f"{solved:.0f} of {trials} at scale {plain(scale)}"
        for scale, solved, trials in zip(
            lacking["error_scale"], lacking["solved_trials"], lacking["trials"], strict=True
        )
    ]
    return common.enumerate_few(seen, 12) or f"all of {_trials(totals)}"


def _at_scales(totals: pd.DataFrame, column: str) -> str:
    pairs = zip(totals["error_scale"], totals[column], strict=True)
    return "; ".join(f"{v:.3g} at scale {plain(s)}" for s, v in pairs if np.isfinite(v)) or "no scale"


FIGURE = Figure(draw, ("summary", "by_group"), main=True)
