"""Draws the errors of tracks from epoch to epoch, over all trials, a panel for each tracker."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, Look, strong
from ipe_bench.report.words import enumerate_few, value_text
from ipe_bench.statistics.statistic import ALL

MOST_ERROR = 1e4
"""Errors beyond this many times the filter's are not drawn: such a track is lost."""
_BOUND = "filter or smoother linearised at the truth"


def draw(view: View) -> Iterator[Drawing]:
    """Draws the median error at the largest error scale, and the worst tenth, of all states over
    the filter that is linearised at the true path; then NEES within its limits."""
    rows = view["tracks"]
    if rows.empty:
        return
    scale = rows["error_scale"].max()
    rows = rows[(rows["error_scale"] == scale) & (rows["parameter"] == ALL)]
    totals = view.totals[view.totals["error_scale"] == scale].set_index("estimator")
    at, time = common.times(rows["at"])
    rows = rows.assign(at=at)
    best_first = _best_first(rows, totals)
    shown = best_first[: common.most_panels() - 1]
    look = {label: view.look[label] for label in shown}
    fig, axes = common.panels(len(shown) + 1, look)
    ends = _ends(rows[rows["estimator"].isin(shown)])
    told = {}
    for label in shown:
        kept = round(totals["success"][label] * totals["trials"][label])
        told[label] = f"{kept} of {totals['trials'][label]:.0f} kept: "
    longest = max(len(words) for words in told.values())
    short = common.texts(shown, common.title_letters(axes[0]) - longest)
    for label, ax in zip(shown, axes, strict=False):
        _draw_errors(ax, rows[rows["estimator"] == label], look[label], ends)
        common.title(ax, f"{told[label]}{short[label]}")
    claiming = _draw_nees(axes[-1], rows, totals, look)
    common.axis_labels(fig, time, f"error over {view.reference}")
    axes[-1].set_ylabel("NEES / n")
    common.legend(fig, axes, look if claiming else None)
    hidden = [label for label in best_first if label not in shown]
    yield view.drawing(
        fig,
        "tracks",
        f"Errors of all tracks at error scale {value_text(scale)}",
        "Line: median over all trials. Shade: to the worst tenth; a track without an end counts as"
        " infinite. Kept: the error at the last time step is a success.",
        _claims(rows, claiming),
        f"Not shown, with larger errors: {enumerate_few(hidden, 8)}." if hidden else "",
    )


def _best_first(rows: pd.DataFrame, totals: pd.DataFrame) -> list[str]:
    """Sorts the trackers: most tracks kept first, then the least median error over the path."""
    order = totals.sort_values(
        ["success", "path_error_median"], ascending=[False, True], kind="stable"
    )
    return [str(label) for label in order.index if label in set(rows["estimator"])]


def _ends(rows: pd.DataFrame) -> tuple[float, float]:
    """Returns the ends of the axis of errors that all panels share."""
    values = rows[["median", "q90", "bound"]].to_numpy(dtype=float)
    values = values[np.isfinite(values) & (values > 0)]
    low = min(values.min(initial=1.0), 1.0)
    high = max(values.max(initial=1.0), 10.0)
    return low / 1.5, min(high, MOST_ERROR) * 1.5


def _draw_errors(ax: Any, rows: pd.DataFrame, one: Look, ends: tuple[float, float]) -> None:
    at = rows["at"].to_numpy(dtype=float)
    most = 2 * ends[1]
    median = rows["median"].to_numpy(dtype=float)
    worst = rows["q90"].to_numpy(dtype=float)
    shade = (np.minimum(median, most), np.minimum(worst, most))
    ax.fill_between(at, *shade, color=one.color, alpha=0.2, linewidth=0)
    (line,) = ax.plot(at, np.minimum(median, most), color=strong(one.color), linewidth=1.6)
    common.mark_name(ax, line, str(rows["estimator"].iloc[0]), 0)
    style: Any = {"color": BOUND_COLOR, "linestyle": BOUND_DASH, "linewidth": 1.0}
    ax.plot(at, rows["bound"], label=_BOUND, **style)
    ax.set_yscale("log")
    ax.set_ylim(*ends)
    common.log_ticks(ax.yaxis, *ends)
    lost = at[~(median <= ends[1])]
    # An arrow at a third of the epochs at most: side by side they would be a bar.
    common.mark_cut(ax, lost[:: len(lost) // 3 + 1], ends[1], one.color, downwards=False)


def _draw_nees(
    ax: Any, rows: pd.DataFrame, totals: pd.DataFrame, look: dict[str, Look]
) -> list[str]:
    """Draws NEES over all states, with the limits that it keeps if covariances are right, of the
    trackers that have enough trials to claim it, and the verdict's intervals; returns these."""
    known = rows[rows["estimator"].isin(list(look)) & rows["nees_solved"].notna()]
    common.title(ax, "NEES of solved trials")
    if known.empty:
        ax.set_axis_off()
        return []
    common.lines(ax, known, "at", "nees_solved", look)
    low = known["nees_low_if_honest"].min()
    high = known["nees_high_if_honest"].max()
    common.band(ax, low, high, "95 % limits for a right covariance")
    claiming = list(dict.fromkeys(known["estimator"]))
    judged = totals.loc[claiming]
    common.decades(ax, known["nees_solved"], ends=judged[["nees_mean_low", "nees_mean_high"]])
    for label, row in judged.iterrows():
        ends = [row["nees_mean_low"], row["nees_mean_high"]]
        # Of an interval without an upper end the lower half is drawn.
        top = ends[1] if np.isfinite(ends[1]) else row["nees_mean"]
        ax.vlines(known["at"].max(), ends[0], top, color=look[str(label)].color, linewidth=1.6)
    return claiming


def _claims(rows: pd.DataFrame, claiming: list[str]) -> str:
    """Says of how many solved trials the NEES of each tracker is, unless of all."""
    firsts = rows.drop_duplicates("estimator").set_index("estimator")
    some = [
        f"{label} of {firsts['claims'][label]} solved"
        for label in claiming
        if firsts["claims"][label] < firsts["trials"][label]
    ]
    bars = (
        "Bars at the last time step: the intervals of which verdicts are read." if claiming else ""
    )
    return f"{bars} NEES: {enumerate_few(some, 8)}." if some else bars


FIGURES = (Figure(draw, ("summary", "tracks"), main=True),)
