"""Draws errors parameter by parameter: figures 2 and 3 of the paper, and those of trackers from epoch to epoch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import (
    BLACK,
    BOUND_COLOR,
    BOUND_DASH,
    COLORS,
    GREY,
    MARKERS,
    REFERENCE,
    Look,
)
from ipe_bench.report.words import brief, enumerate_few, value_text
from ipe_bench.statistics.statistic import ALL

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
    if not several:
        fig.set_figheight(fig.get_figheight() + 0.08 * len(view.parameters))
    for (group, inside), ax in zip(groups.items(), axes, strict=False):
        look = {
            p["name"]: Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)])
            for i, p in enumerate(inside)
        }
        if not several:
            common.name_axis(ax, list(look))
        part = rows[rows["parameter"].isin(list(look))]
        common.decades(ax, part[["rmse", "linear_bound"]], ends=part[["rmse_low", "rmse_high"]])
        for i, (name, one) in enumerate(look.items()):
            bound = part[part["parameter"] == name].sort_values("error_scale")
            style: Any = {"color": one.color, "linestyle": BOUND_DASH, "linewidth": 1.0}
            if several:
                ax.plot(bound["error_scale"], bound["linear_bound"], **style)
            else:
                ax.vlines(bound["linear_bound"], i - 0.3, i + 0.3, **style)
        legend = len(inside) > 1 and several
        if legend:
            low, high = ax.get_ylim()
            ax.set_ylim(low, high * (high / low) ** (0.05 * (len(inside) + 1)))
        _curves(ax, part, look, view, group, inside[0]["unit"])
        if legend:
            lines: list[Any] = [one.line | {"linestyle": "none"} for one in look.values()]
            handles = [ax.plot([], [], **line)[0] for line in lines]
            tight: Any = {
                "handlelength": 0.4,
                "handletextpad": 0.4,
                "columnspacing": 0.8,
                "borderaxespad": 0.2,
            }
            ax.legend(
                handles,
                list(map(common.text, look)),
                ncols=2,
                fontsize="small",
                loc="upper left",
                **tight,
            )
    ratio, last = "rmse_over_linear_bound", axes[-1]
    each, together = {p["name"]: Look(GREY, ",") for p in view.parameters}, {ALL: Look(BLACK, "o")}
    if not several:
        common.name_axis(last, [ALL])
    common.decades(
        last, np.append(rows[ratio], [1.0, *totals["rmse"]]), ends=totals[["rmse_low", "rmse_high"]]
    )
    if several:
        _curves(last, rows.assign(rmse=rows[ratio]), each, view)
        last.plot([], [], color=GREY, label="each parameter")
    _curves(last, totals, together, view, "all parameters", "bounds")
    common.bound_line(last, 1.0, "linear bound, eq. (5)")
    common.legend(fig, axes[-1:])
    at = [
        f"{brief(v)} at scale {value_text(s)}"
        for s, v in totals[["error_scale", "rmse"]].dropna().to_numpy()[-1:]
    ]
    number = 2 if estimator == REFERENCE else 3
    of_paper = f"Figure {number} of the paper: " if view.paper else ""
    return view.drawing(
        fig,
        f"figure_{number}" if view.paper else f"parameter_errors_{estimator}",
        f"{of_paper}error of {estimator}, solved trials",
        f"Root mean square error and 95 % interval of the trials solved ({_missing(totals)}). Dotted: linear bounds.",
        f"All together: {at[0]}." if at else "",
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


def _curves(ax: Any, rows: Any, look: Any, view: View, heading: str = "", unit: str = "") -> None:
    given: Any = {"by": "parameter", "trials": "solved_trials", "heading": heading}
    given["label"] = common.text(f"rms error [{unit}]" if unit else "rms error")
    common.curves(ax, rows, "rmse", look, view.scales, interval=("rmse_low", "rmse_high"), **given)


def _missing(totals: pd.DataFrame) -> str:
    """Says in how many trials an estimator solved the equation at the largest scale where it did not in all."""
    lacking = totals[totals["solved_trials"] < totals["trials"]].tail(1)
    rows = lacking[["solved_trials", "trials", "error_scale"]].to_numpy()
    seen = [
        f"{solved:.0f} of {trials:.0f} at scale {value_text(scale)}"
        for solved, trials, scale in rows
    ]
    return "".join(seen) or f"all of {totals['trials'].min():.0f}"


def draw_tracks(view: View) -> Iterator[Drawing]:
    """Draws the root mean square error of each state beside its bounds, and NEES within its limits, at the largest
    error scale."""
    rows = view["tracks"]
    if rows.empty:
        return
    rows = rows[rows["error_scale"] == (scale := rows["error_scale"].max())]
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
                ax.plot(
                    same["at"],
                    same["bound"],
                    linestyle=dash,
                    label=f"{kind} linearised at the truth",
                    **style,
                )
        for name, dash, label in (
            ("posterior", ":", "posterior bound of filters"),
            ("posterior_smoothed", "-.", "posterior bound of smoothers"),
        ):
            if np.isfinite(one[name]).any():
                ax.plot(
                    one["at"],
                    one[name],
                    dash,
                    color=BOUND_COLOR,
                    linewidth=1.0,
                    label=label,
                    zorder=1,
                )
        common.decades(ax, part[["rmse", "bound", "posterior", "posterior_smoothed"]])
        unit = f" [{one['unit'].iloc[0]}]" if one["unit"].iloc[0] else ""
        common.title(ax, state)
        ax.set(xlabel="time [s]", ylabel=common.text(f"rms error{unit}"))
    first, ax = rows[rows["parameter"] == states[0]], axes[-1]
    common.lines(ax, first, "at", "nees", look, legend=False)
    low, high = (first[f"nees_{end}_if_honest"].iloc[0] for end in ("low", "high"))
    common.band(ax, low, high, "95 % limits for a right covariance")
    common.decades(ax, first["nees"])
    common.title(ax, "NEES")
    ax.set(xlabel="time [s]", ylabel="NEES / n")
    common.legend(fig, axes, look)
    total = {
        name: np.sqrt(np.mean(part["rmse"] ** 2))
        for name, part in first.groupby("estimator", sort=False)
    }
    yield view.drawing(
        fig,
        "tracks",
        f"Tracks at error scale {value_text(scale)}, converged trials",
        "Root mean square error at each epoch, with the bound along the true path; NEES over states.",
        f"{states[0]} over all epochs: {enumerate_few([f'{k} {v:.3g}' for k, v in total.items()], 3)}.",
    )


FIGURES = (Figure(draw, ("summary",)), Figure(draw_tracks, ("tracks",), main=True))
