"""Draws errors parameter by parameter: figures 2 and 3 of the paper."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.measurements.base import with_unit
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import (
    BLACK,
    BOUND_DASH,
    COLORS,
    GREY,
    MARKERS,
    REFERENCE,
    Look,
)
from ipe_bench.report.words import value_text
from ipe_bench.statistics.statistic import ALL

MOST_GROUPS = 8
"""Groups of parameters that have panels."""
_ENDS = ("rmse_solved_low", "rmse_solved_high")


def draw(view: View) -> Iterator[Drawing]:
    """Draws the errors of the reference and of an estimator that iterates, over the error scales;
    of a single scale the table says it all."""
    if len(view.scales) < 2:
        return
    iterated = [e for e in view.look if view.equations[e] == "frozen"]
    iterated.sort(key=lambda e: e != "fixed_point")
    for label in (REFERENCE, *iterated[:1]):
        if label in view.look:
            yield _of_one(view, label)


def _of_one(view: View, estimator: str) -> Drawing:
    """Draws a panel per group of parameters in physical units, and one of all of them over their
    bounds."""
    rows = view.summary.query("estimator == @estimator and parameter != @ALL")
    totals = view.totals[view.totals["estimator"] == estimator].assign(parameter=ALL)
    groups = _groups(view.parameters)
    fig, axes = common.panels(len(groups) + 1, height=2.4)
    for (group, inside), ax in zip(groups.items(), axes, strict=False):
        _draw_group(ax, rows, view, group, inside)
    _draw_ratios(axes[-1], rows, totals, view)
    common.legend(fig, axes[-1:])
    number = 2 if estimator == REFERENCE else 3
    of_paper = f"Figure {number} of the paper: " if view.paper else ""
    return view.drawing(
        fig,
        f"figure_{number}" if view.paper else f"parameter_errors_{estimator}",
        f"{of_paper}error of {estimator}, solved trials",
        f"Root mean square error and 95 % interval of the trials solved ({_missing(totals)})."
        " Dotted: linear bounds.",
    )


def _draw_group(
    ax: Any, rows: pd.DataFrame, view: View, group: str, inside: Sequence[Mapping[str, Any]]
) -> None:
    """Draws the errors of a group's parameters over the scales, with their bounds."""
    look: dict[str, Look] = {}
    for i, parameter in enumerate(inside):
        look[parameter["name"]] = Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)])
    part = rows[rows["parameter"].isin(list(look))]
    common.decades(ax, part[["rmse_solved", "linear_bound"]], ends=part[[*_ENDS]])
    for name, one in look.items():
        own = part[part["parameter"] == name].sort_values("error_scale")
        style: Any = {"color": one.color, "linestyle": BOUND_DASH, "linewidth": 1.0}
        ax.plot(own["error_scale"], own["linear_bound"], **style)
    has_legend = len(inside) > 1
    if has_legend:
        low, high = ax.get_ylim()
        room = 0.05 * (len(inside) + 1)
        ax.set_ylim(low, high * (high / low) ** room)
    _curves(ax, part, look, view, group, inside[0]["unit"])
    if has_legend:
        _name_parameters(ax, look)


def _name_parameters(ax: Any, look: Mapping[str, Look]) -> None:
    """Adds a legend of markers within the panel."""
    handles = []
    for one in look.values():
        style = one.line | {"linestyle": "none"}
        handles += ax.plot([], [], **style)
    tight: Any = {"handlelength": 0.4, "handletextpad": 0.4}
    tight |= {"columnspacing": 0.8, "borderaxespad": 0.2, "fontsize": "small"}
    ax.legend(handles, list(map(common.text, look)), ncols=2, loc="upper left", **tight)


def _draw_ratios(ax: Any, rows: pd.DataFrame, totals: pd.DataFrame, view: View) -> None:
    """Draws the errors over their linear bounds, of all parameters together and each in grey."""
    ratio = rows["rmse_solved_over_linear_bound"]
    values = np.append(ratio, [1.0, *totals["rmse_solved"]])
    common.decades(ax, values, ends=totals[[*_ENDS]])
    grey = {parameter["name"]: Look(GREY, ",") for parameter in view.parameters}
    _curves(ax, rows.assign(rmse_solved=ratio), grey, view)
    ax.plot([], [], color=GREY, label="each parameter")
    _curves(ax, totals, {ALL: Look(BLACK, "o")}, view, "all parameters", "bounds")
    common.bound_line(ax, 1.0, "linear bound, eq. (5)")


def _groups(parameters: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Returns the parameters of one group and one unit, under the group's name; empty if there are
    too many groups."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for p in parameters:
        group = p.get("group") or p["name"]
        if group in groups and groups[group][0]["unit"] != p["unit"]:
            group = f"{group} ({p['name']})"
        groups.setdefault(group, []).append(p)
    return groups if len(groups) <= MOST_GROUPS else {}


def _curves(ax: Any, rows: Any, look: Any, view: View, heading: str = "", unit: str = "") -> None:
    label = common.text(with_unit("rms error", unit))
    words: Any = {"by": "parameter", "heading": heading, "label": label}
    numbers: Any = {"trials": "solved_trials", "interval": _ENDS}
    common.curves(ax, rows, "rmse_solved", look, view.scales, **words, **numbers)


def _missing(totals: pd.DataFrame) -> str:
    """Says in how many trials an estimator solved the equation at the largest scale where it did
    not in all."""
    lacking = totals[totals["solved_trials"] < totals["trials"]]
    if lacking.empty:
        return f"all of {totals['trials'].min():.0f}"
    last = lacking.iloc[-1]
    share = f"{last['solved_trials']:.0f} of {last['trials']:.0f}"
    return f"{share} at scale {value_text(float(last['error_scale']))}"


FIGURES = (Figure(draw, ("summary",)),)
