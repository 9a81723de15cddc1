"""Draws errors parameter by parameter: figures 2 and 3 of the paper, and those of trackers from epoch to epoch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import BLACK, BOUND_COLOR, BOUND_DASH, COLORS, GREY, MARKERS, REFERENCE, Look
from ipe_bench.report.words import brief, enumerate_few, value_text
from ipe_bench.statistics.records import ALL

MOST_GROUPS = 8
"""Groups of parameters that have panels."""


def draw(view: View) -> Iterator[Drawing]:
    if view.totals.empty:
        return
    iterated = [e for e in view.look if view.equations[e] == "frozen"]
    for label in (REFERENCE, *sorted(iterated, key=lambda e: e != "fixed_point")[:1]):
        if label in view.look:
            yield _of_one(view, label)


def _of_one(view: View, estimator: str) -> Drawing:
    """Draws a panel per group of parameters in physical units, and one of all of them over their bounds."""
    rows = view["summary"].query("estimator == @estimator and parameter != @ALL")
    rows = rows.assign(solved_trials=(rows["solved"] * rows["trials"]).round())
    totals = view.totals[view.totals["estimator"] == estimator].assign(parameter=ALL)
    groups, several = _groups(view.parameters), len(view.scales) > 1
    fig, axes = common.panels(len(groups) + 1, height=2.4)
    for (group, inside), ax in zip(groups.items(), axes, strict=False):
        look = {p["name"]: Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]) for i, p in enumerate(inside)}
        part = rows[rows["parameter"].isin(list(look))]
        common.decades(ax, part[["rmse", "linear_bound"]], ends=part[["rmse_low", "rmse_high"]])
        for i, (name, one) in enumerate(look.items()):
            bound = part[part["parameter"] == name].sort_values("error_scale")
            style: Any = {"color": one.color, "linestyle": BOUND_DASH, "linewidth": 1.0}
            if several:
                ax.plot(bound["error_scale"], bound["linear_bound"], **style)
            else:
                ax.hlines(bound["linear_bound"], i - 0.3, i + 0.3, **style)
        _curves(ax, part, look, view, group)
        if len(inside) > 1 and several:
            low, high = ax.get_ylim()
            ax.set_ylim(low, high * (high / low) ** (0.05 * (len(inside) + 1)))
            lines: list[Any] = [one.line | {"linestyle": "none"} for one in look.values()]
            handles = [ax.plot([], [], **line)[0] for line in lines]
            tight: Any = {"handlelength": 0.4, "handletextpad": 0.4, "columnspacing": 0.8, "borderaxespad": 0.2}
            ax.legend(handles, list(map(common.text, look)), ncols=2, fontsize="small", loc="upper left", **tight)
    ratio, last = "rmse_over_linear_bound", axes[-1]
    common.decades(last, np.append(rows[ratio], [1.0, *totals["rmse"]]), ends=totals[["rmse_low", "rmse_high"]])
    _curves(last, rows.assign(rmse=rows[ratio]), {p["name"]: Look(GREY, ",") for p in view.parameters}, view)
    together = Look(BLACK, "o")
    _curves(last, totals, {ALL: together}, view, "all parameters")
    common.bound_line(last, 1.0, "linear bound, eq. (5)")
    last.plot([], [], color=GREY, label="each parameter")
    common.axis_labels(fig, "error scale" if several else "", "rms error")
    for ax, unit in zip(axes, [*(inside[0]["unit"] for inside in groups.values()), "bounds"], strict=True):
        ax.set_ylabel(common.text(f"[{unit}]" if unit else ""))
    common.legend(fig, axes[-1:], {"all together": together})
    at = [f"{brief(v)} at scale {value_text(s)}" for s, v in totals[["error_scale", "rmse"]].dropna().to_numpy()]
    number = 2 if estimator == REFERENCE else 3
    of_paper = f"Figure {number} of the paper: " if view.paper else ""
    return view.drawing(
        fig,
        f"figure_{number}" if view.paper else f"parameter_errors_{estimator}",
        f"{of_paper}error of {estimator}, solved trials",
        f"Root mean square error of {estimator} over the trials that it solved ({_missing(totals)}), with 95 %"
        " bootstrap intervals, whose upper ends are drawn where no larger errors may be unseen; dotted: the linear"
        " bound. Last panel: the same over the bounds.",
        f"All parameters together: {'; '.join(at)}." if at else "",
    )


def _groups(parameters: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Returns the parameters of one group and one unit, under the group's name; empty if there are too many groups."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for p in parameters:
        group = p.get("group") or p["name"]
        if group in groups and groups[group][0]["unit"] != p["unit"]:
            group = f"{group} ({p['name']})"
        groups.setdefault(group, []).append(p)
    return groups if len(groups) <= MOST_GROUPS else {}


def _curves(ax: Any, rows: Any, look: Any, view: View, heading: str = "") -> None:
    given: Any = {"by": "parameter", "trials": "solved_trials", "heading": heading}
    common.curves(ax, rows, "rmse", look, view.scales, interval=("rmse_low", "rmse_high"), **given)


def _missing(totals: pd.DataFrame) -> str:
    """Says in how many trials an estimator solved the equation at each scale."""
    lacking = totals[totals["solved_trials"] < totals["trials"]]
    rows = lacking[["solved_trials", "trials", "error_scale"]].to_numpy()
    seen = [f"{solved:.0f} of {trials:.0f} at scale {value_text(scale)}" for solved, trials, scale in rows]
    return enumerate_few(seen, 12) or f"all of {totals['trials'].min():.0f}"


def draw_tracks(view: View) -> Iterator[Drawing]:
    """Draws the root mean square error of each state beside its bounds, and NEES within its limits."""
    rows = view["tracks"]
    if rows.empty:
        return
    look = view.with_look(rows["estimator"])
    states = list(dict.fromkeys(rows["parameter"]))[: common.MOST_PANELS - 1]
    fig, axes = common.panels(len(states) + 1, look)
    for state, ax in zip(states, axes, strict=False):
        part = rows[rows["parameter"] == state]
        common.lines(ax, part, "at", "rmse", look, legend=False)
        one = part[part["estimator"] == part["estimator"].iloc[0]]
        for smooths, dash, kind in ((False, "--", "filter"), (True, (0, (5, 1)), "smoother")):
            those = part[part["smooths"] == smooths]
            if len(those) and np.isfinite(those["bound"]).any():
                same = those[those["estimator"] == those["estimator"].iloc[0]]
                style: Any = {"color": BOUND_COLOR, "linewidth": 1.0, "zorder": 1}
                ax.plot(same["at"], same["bound"], linestyle=dash, label=f"{kind} linearised at the truth", **style)
        for name, dash, label in (
            ("posterior", ":", "posterior bound of filters"),
            ("posterior_smoothed", "-.", "posterior bound of smoothers"),
        ):
            if np.isfinite(one[name]).any():
                ax.plot(one["at"], one[name], dash, color=BOUND_COLOR, linewidth=1.0, label=label, zorder=1)
        common.decades(ax, part[["rmse", "bound", "posterior", "posterior_smoothed"]])
        common.title(ax, f"{state} [{one['unit'].iloc[0]}]" if one["unit"].iloc[0] else state)
    first, ax = rows[rows["parameter"] == states[0]], axes[-1]
    common.lines(ax, first, "at", "nees", look, legend=False)
    ax.axhspan(first["nees_low"].iloc[0], first["nees_high"].iloc[0], color=BOUND_COLOR, alpha=0.25, zorder=0)
    common.decades(ax, first["nees"])
    common.title(ax, "NEES / n")
    common.axis_labels(fig, "time [s]", "")
    common.legend(fig, axes, look)
    total = {name: np.sqrt(np.mean(part["rmse"] ** 2)) for name, part in first.groupby("estimator", sort=False)}
    yield view.drawing(
        fig,
        "tracks",
        "Tracks, converged trials",
        "Root mean square error over trials at each epoch, with that of the filter, and of the smoother, linearised at"
        " the truth, which good ones attain, and the posterior Cramér-Rao bounds, which lie far below. NEES over n"
        " stays within the band at 95 % of single epochs if the covariance is right; neighbouring epochs are"
        " dependent.",
        f"{states[0]} over all epochs: {enumerate_few([f'{k} {v:.3g}' for k, v in total.items()], 20)}.",
    )


FIGURES = (Figure(draw, ("summary",)), Figure(draw_tracks, ("tracks",), main=True))
