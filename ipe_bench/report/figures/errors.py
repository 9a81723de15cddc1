"""Draws success, error and honesty of all trials, the distribution of errors and the calibration of
NEES."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import gammainc

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.headline import chosen
from ipe_bench.report.figures.views import Figure, View, in_focus, only
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, Look, print_width, strong
from ipe_bench.report.words import enumerate_few, value_text

CEILING = {"error_median": 100.0, "error_q95": 100.0, "nees_mean": 30.0}
"""Errors beyond are drawn here: the size of a diverged error carries no information, and the bound
needs the room."""
BARS = (
    "Bars: 95 % intervals of success and, for errors like those seen, of the mean NEES; errors"
    " from the median to the 95 % quantile."
)
_ALONG = " Success and NEES: at the last time step. Error: over all time steps."
_NEES = ("nees_mean_low", "nees_mean_high")
_ALL = 0.995
"""Success that all estimators have where they are alike."""
_APART = 0.1
"""Part by which errors and NEES of estimators that are alike differ at most."""
_WIDE = 5.0
"""Inches of a column of print from which on there is room for names at curves."""
LINEAR = 0.1
"""Differences below this are drawn about in proportion, larger ones by their logarithm: honest
curves differ by hundredths, dishonest ones by up to 1."""
_TICKS = (-1.0, -0.3, -0.1, -0.05, 0.0, 0.05, 0.1, 0.3, 1.0)
"""Differences that may have a tick."""


def draw(view: View) -> Iterator[Drawing]:
    """Draws success, error and, where a covariance is reported, NEES: over the error scales with
    names at the curves' ends, from where estimators part; at one scale a row for each."""
    totals = over_paths(view) if view.moving else view.totals
    several = len(view.scales) > 1
    start = _parting(view, totals) if several else view.scales[0]
    scales = [scale for scale in view.scales if scale >= start]
    rows = totals[totals["error_scale"] >= start]
    # Many curves hide each other: those of README's picture are drawn.
    kept = {*view.focus, *chosen(totals, view.families)} if several else {*view.look}
    rows = rows[rows["estimator"].isin(kept)]
    count = 3 if rows["nees_mean"].notna().any() else 2
    height = max(3.3, 0.17 * len(view.look) + 1.6)
    look = _looks(view) if several else view.look
    hidden = [label for label in look if label not in kept]
    look = only(look, kept)
    fig, axes = common.panels(count, look, height=height, scales=scales, row=count)
    draw_panels(view, axes, rows, look, scales)
    named = several and not 0 < print_width() < _WIDE
    if named:
        common.end_names(axes[0], rows, "success", look)
    common.legend(fig, axes, {} if named else look)
    over = "over error scales" if several else f"at error scale {value_text(start)}"
    title = f"Success, error and reported covariance {over}"
    said = ""
    if start > view.scales[0]:
        said = f"Up to error scale {value_text(start)} all are alike: the axis starts there."
    told = f"{BARS}{_ALONG}" if view.moving else BARS
    left_out = f"Not drawn: {enumerate_few(hidden, 4)}." if hidden else ""
    yield view.drawing(fig, "headline", title, said, told, _solved_in_words(rows), left_out)


def over_paths(view: View) -> pd.DataFrame:
    """Returns the totals with errors over all epochs, where a smoother is better than its filter:
    at the last they are equal by definition."""
    totals = view.totals
    along = {name: totals[f"path_{name}"] for name in ("error_median", "error_q95")}
    return totals.assign(**along)


def _looks(view: View) -> dict[str, Look]:
    """Returns the looks with a strong line for the winner, and those out of focus in grey."""
    look = in_focus(view.look, view.focus)
    if view.winner:
        own = look[view.winner]
        look[view.winner] = replace(own, color=strong(own.color), width=1.6)
    return look


def _parting(view: View, totals: pd.DataFrame) -> float:
    """Returns the last of the scales up to which all estimators are alike, so that at least three
    are left; the first if they never part."""
    whole = totals["estimator"].nunique()
    alike = []
    for scale in view.scales:
        here = totals[totals["error_scale"] == scale]
        with np.errstate(all="ignore"):
            judged = here[["error_median", "nees_mean"]]
            spreads = judged.max() / judged.min()
        # Of a statistic that no estimator has, the spread is NaN.
        close = not (spreads > 1 + _APART).any()
        complete = len(here) == whole
        alike.append(complete and here["success"].min() >= _ALL and close)
    if all(alike):
        return view.scales[0]
    last_alike = max(alike.index(False) - 1, 0)
    third_last = max(len(alike) - 3, 0)
    return view.scales[min(last_alike, third_last)]


def _solved_in_words(rows: pd.DataFrame) -> str:
    """Says of how many converged trials the NEES is that fewer claim than there are, at the scale
    where fewest do."""
    some = rows[rows["nees_mean"].notna() & (rows["claims"] < rows["trials"])]
    if some.empty:
        return ""
    fewest = some.sort_values("claims", kind="stable").drop_duplicates("estimator")
    told = [
        f"{label} {claims:.0f} of {trials:.0f}"
        for label, claims, trials in fewest[["estimator", "claims", "trials"]].to_numpy()
    ]
    return f"NEES is of converged trials, at the fewest {enumerate_few(told, 8)}."


def draw_panels(
    view: View,
    axes: Sequence[Any],
    rows: pd.DataFrame,
    look: Mapping[str, Look],
    scales: Sequence[float],
) -> None:
    """Draws success, error and, if there is a third panel, NEES."""
    success, error, *third = axes
    shown = (look, scales)
    words: dict[str, Any] = {"heading": "success", "label": "share of all trials"}
    words["interval"] = ("success_low", "success_high")
    common.shares(success)
    common.curves(success, rows, "success", *shown, **words)
    capped = rows[list(CEILING)].clip(upper=pd.Series(CEILING), axis=1)
    best = f"1: {view.reference}, a right covariance"
    words = {"heading": f"error over {view.reference}", "label": "median, bar to 95 %"}
    words |= {"most": CEILING["error_q95"], "interval": ("error_median", "error_q95")}
    if view.moving:
        words["label"] = "over all time steps: median, bar to 95 %"
    common.decades(error, capped[["error_median", "error_q95"]], least=4.0)
    common.bound_line(error, 1.0, best)
    common.curves(error, rows, "error_median", *shown, **words)
    claims = rows[rows["nees_mean"].notna()]
    for nees in third:
        values = capped["nees_mean"].clip(lower=0.5)
        common.decades(nees, np.append(values, 1.0), least=4.0, ends=claims[[*_NEES]])
        common.bound_line(nees, 1.0, best)
        words = {"heading": "NEES", "label": "mean of converged", "most": CEILING["nees_mean"]}
        words |= {"trials": "claims", "interval": _NEES}
        common.curves(nees, claims, "nees_mean", *shown, **words)


def draw_distributions(view: View) -> Iterator[Drawing]:
    """Draws distribution functions of the error, a panel per error scale."""
    rows = view["distributions"]
    if rows.empty:
        return
    look = view.with_look(rows["estimator"])
    most = CEILING["error_q95"]
    error = rows["distance"] / np.sqrt(view.n)
    low = 0.7 * error.clip(0.1, 1.0).min()
    high = 1.5 * error.clip(2.0, most / 1.5).max()
    # Each curve rises from none within the panel, and what lies beyond its edge is not seen.
    rows = rows.assign(error=error.clip(low / 2, 2 * most))
    fig, panels = common.panels_of_scales(rows, look)
    for ax, part in panels:
        common.shares(ax)
        if not view.moving:  # the errors of an epoch and of the next are dependent
            at = np.geomspace(low, high, 200)
            chi = gammainc(view.n / 2, view.n * at**2 / 2)
            bound: Any = {"color": BOUND_COLOR, "linestyle": BOUND_DASH, "linewidth": 1.0}
            ax.plot(at, chi, label="efficient estimator", zorder=1, **bound)
        common.lines(ax, part, "error", "probability", look)
        ax.set_xscale("log")
        ax.set_xlim(low, high)
        common.log_ticks(ax.xaxis, low, high)
    common.axis_labels(fig, f"error over {view.reference}", "share of all trials")
    common.legend(fig, fig.axes, look)
    yield view.drawing(
        fig,
        "distributions",
        "Distribution of errors, all trials",
        "Share of all trials with at most that error.",
        common.left_out(view.scales, panels),
    )


def draw_calibration(view: View) -> Iterator[Drawing]:
    """Draws the calibration of NEES of all estimators, a panel per error scale."""
    rows = view["calibration"]
    if rows.empty:
        return
    look = view.with_look(rows["estimator"])
    fig, panels = common.panels_of_scales(rows, look)
    largest = rows[["difference", "low", "high"]].abs().max().max()
    reach = 1.15 * max(LINEAR, float(largest))
    ticks = [at for at in _TICKS if abs(at) <= reach]
    for ax, part in panels:
        ax.set_yscale("asinh", linear_width=LINEAR / 2)
        ax.set(xlim=(0, 1), ylim=(-reach, reach))
        ax.set_yticks(ticks, [common.number(at) for at in ticks])
        ax.set_yticks([], minor=True)
        _bands(ax, part)
        common.lines(ax, part, "at", "difference", look)
    common.axis_labels(fig, "nominal probability", "observed − nominal")
    common.legend(fig, fig.axes, look)
    yield view.drawing(
        fig,
        "calibration",
        "Calibration of NEES, converged trials",
        "Share of converged trials whose NEES is below each quantile of chi-square, less its"
        f" nominal probability. Grey: 95 % bands. Logarithmic beyond ±{LINEAR / 2:g}.",
        common.left_out(view.scales, panels),
    )


def _bands(ax: Any, rows: pd.DataFrame) -> None:
    """Draws the widest and the narrowest band of the panel's curves."""
    widths = rows["high"] - rows["low"]
    mean = widths.groupby(rows["estimator"]).mean()
    for label, alpha in ((mean.idxmax(), 0.12), (mean.idxmin(), 0.15)):
        edge = rows[rows["estimator"] == label].drop_duplicates("at")
        style: Any = {"color": BOUND_COLOR, "alpha": alpha, "linewidth": 0, "zorder": 0}
        ax.fill_between(edge["at"], edge["low"], edge["high"], **style)
    ax.axhline(0, color=BOUND_COLOR, linewidth=0.6, zorder=1)


FIGURES = (
    Figure(draw, ("summary",), main=True),
    Figure(draw_distributions, ("distributions",)),
    Figure(draw_calibration, ("summary", "calibration")),
)
