"""Errors of all trials: the headline of success, error and honesty, errors against the scale, and distributions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import gammainc, gammaincinv

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH
from ipe_bench.report.words import percent, plain
from ipe_bench.trials.thresholds import GATE

NEAR = 2.0
"""Panels that zoom on the bound show errors up to this multiple of it."""
HALF, MOST = 0.5, 0.95
"""Shares of the trials whose errors lie below what is drawn."""


CEILING = {"error_median": 100.0, "error_q95": 100.0, "nees_median": 30.0}
"""What lies beyond is drawn there: how far a diverged estimate is off tells nothing, and the bound needs the room."""


def draw_headline(view: View) -> Iterator[Drawing]:
    totals = view.totals
    if totals.empty:
        return
    beyond = bool((totals[list(CEILING)] > pd.Series(CEILING)).any(axis=None))
    totals = totals.assign(**{name: totals[name].clip(upper=most) for name, most in CEILING.items()})
    claims = totals[totals["nees_median"].notna()]
    fig, axes = common.panels(3 if len(claims) else 2, view.look, height=3.3)
    shown = view.look, view.scales
    words: dict[str, Any] = {"heading": "success", "label": "share of all trials"}
    common.shares(axes[0], "")
    common.curves(axes[0], totals, "success", *shown, interval=("success_low", "success_high"), **words)
    words = {"heading": "error over the bound", "label": "median, bar to 95 %"}
    common.decades(axes[1], totals[["error_median", "error_q95"]].clip(lower=0.5), least=4.0)
    common.bound_line(axes[1], 1.0, "1: the bound, an honest covariance")
    common.curves(axes[1], totals, "error_median", *shown, interval=("error_median", "error_q95"), **words)
    if len(claims):
        nees = axes[2]
        common.decades(nees, np.append(claims["nees_median"].clip(lower=0.5), 1.0), least=4.0)
        common.bound_line(nees, 1.0, "1: the bound, an honest covariance")
        limits = claims["nees_median_low"].min(), claims["nees_median_high"].max()
        nees.axhspan(*limits, color=BOUND_COLOR, alpha=0.15, linewidth=0, label="limits of an honest one, 95 %")
        words = {"heading": "squared error over claimed variance", "label": "NEES, median"}
        common.curves(nees, claims, "nees_median", *shown, **words)
    common.legend(fig, axes, view.look)
    over = "over error scales" if len(view.scales) > 1 else f"at error scale {plain(view.scales[0])}"
    last = common.at_scale(totals, view.scales[-1]).sort_values("success", ascending=False, kind="stable")
    ranked = [f"{e} {percent(v)}" for e, v in zip(last["estimator"], last["success"], strict=True)]
    most = f"What exceeds {CEILING['error_median']:g} bounds, or {CEILING['nees_median']:g} times the claimed variance"
    yield view.drawing(
        fig,
        "headline",
        f"Success, error and honesty {over}",
        "All trials of everybody. Left: share whose error lies inside the gate of the bound, with Clopper-Pearson 95 %"
        " intervals. Middle: median error over the bound at the truth, with a bar up to the 95 % quantile. Right:"
        " squared error over the variance that the estimator claims, 1 where it is honest.",
        f"{most}, stands at the top." if beyond else "",
        f"At scale {plain(view.scales[-1])} succeed: {common.enumerate_few(ranked, 20)}.",
    )


def efficient(share: float, n: int) -> float:
    """The quantile of an efficient estimator's Mahalanobis error: that of chi with n degrees of freedom."""
    return float(np.sqrt(2 * gammaincinv(n / 2, share)))


def quantiles(view: View, share: float) -> pd.DataFrame:
    """What that share of all trials err less than, over the same of an efficient estimator: 1 at the Cramér-Rao bound.

    A row per error scale and estimator with `trials`, `error` and its 95 % interval from `low` to `high`, which are
    order statistics: between them lies the true quantile whatever the errors' distribution (binomial counts). An end
    beyond the last trial is infinite, and so is an error if too many estimates are not finite.
    """
    from scipy.stats import binom

    trials: Any = view.totals.set_index(["error_scale", "estimator"])["trials"]
    found = []
    for key, part in view["distributions"].groupby(["error_scale", "estimator"], sort=False):
        count = int(trials[key])
        at, errors = part["probability"].to_numpy(), part["distance"].to_numpy() / efficient(share, view.n)
        low, high = np.add(binom.interval(0.95, count, share), (0, 1)) / count
        ends = errors[at <= low][-1] if low > 0 else 0.0, errors[at >= high][0] if high < 1 else np.inf
        found.append((*key, count, errors[np.searchsorted(at, share - 1e-9)], *ends))
    return pd.DataFrame(found, columns=["error_scale", "estimator", "trials", "error", "low", "high"])


def draw_against_scale(view: View) -> Iterator[Drawing]:
    if view["distributions"].empty:
        return
    look, several, top = view.look, len(view.scales) > 1, plain(view.scales[-1])
    fig, axes = common.panels(4, look, height=2.5)
    for share, (wide, near), name in ((HALF, axes[:2], "median"), (MOST, axes[2:], "95 %")):
        rows = quantiles(view, share).replace({"error": np.inf}, np.nan)
        common.decades(wide, np.append(rows["error"], 1.0), ends=rows[["low", "high"]])
        close = rows.assign(error=rows["error"].where(rows["error"] <= NEAR))
        highs = rows["high"].where(close["error"].notna() & np.isfinite(rows["high"]))
        low, high = np.nanmin([0.9, *close["error"]]), min(np.nanmax([1.1, *close["error"], *highs]), NEAR)
        near.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
        for ax, shown, heading in ((wide, rows, f"{name} of all trials"), (near, close, f"{name}, near the bound")):
            common.curves(ax, shown, "error", look, view.scales, interval=("low", "high"), heading=heading)
            common.bound_line(ax, 1.0, "Cramér-Rao bound")
    common.axis_labels(fig, "error scale" if several else "", "error / efficient estimator's")
    common.legend(fig, axes, look)
    last = common.at_scale(quantiles(view, MOST), view.scales[-1])
    yield view.drawing(
        fig,
        "error_against_scale",
        "Error against error scale, all trials" if several else f"Error at error scale {top}, all trials",
        "Mahalanobis error of all trials, those that failed included, over that of an efficient estimator: median"
        " above, 95 % quantile below; decades left, and right the same near the bound, up to"
        f" {plain(NEAR)}. Bars: 95 % intervals by order statistics.",
        f"95 % of the trials at scale {top} err by less than, in bounds:"
        f" {common.values_of(last, 'error') or 'no finite number'}.",
    )


def draw_distributions(view: View) -> Iterator[Drawing]:
    frame = view["distributions"].assign(error=view["distributions"]["distance"] / np.sqrt(view.n))
    if frame.empty:
        return
    look = view.with_look(frame["estimator"])
    fig, panels = common.panels_of_scales(frame[np.isfinite(frame["error"]) & (frame["error"] > 0)], look)
    x = np.geomspace(efficient(0.001, view.n), efficient(0.9999, view.n), 200)
    gate = efficient(1 - GATE, view.n) / np.sqrt(view.n)
    for ax, here in panels:
        band = {"color": BOUND_COLOR, "linewidth": 4, "alpha": 0.25, "label": "efficient estimator (chi)"}
        ax.plot(x / np.sqrt(view.n), gammainc(view.n / 2, x**2 / 2), **band)
        ends = min(here["error"].min(), 0.5) / 1.2, max(here["error"].max(), 2.5) * 1.2
        common.steps(ax, here, "error", "probability", look, *ends)
        ax.axvline(gate, color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0, label="gate of success")
    common.axis_labels(fig, "Mahalanobis error / √n", "share of all trials below")
    common.legend(fig, fig.axes, look)
    last = common.at_scale(frame, view.scales[-1])
    yield view.drawing(
        fig,
        "error_distributions",
        "Distribution of errors, all trials",
        "Share of all trials whose Mahalanobis error (in standard deviations of the Cramér-Rao bound, over the root of"
        " the number of parameters) is below the abscissa; a curve that ends below 100 % belongs to an estimator some"
        " of whose estimates are not finite.",
        f"Medians at scale {plain(view.scales[-1])}: {common.values_of(last[last['probability'] == HALF], 'error')}.",
    )


FIGURES = (
    Figure(draw_headline, ("summary",), main=True),
    Figure(draw_against_scale, ("summary", "distributions"), main=True),
    Figure(draw_distributions, ("summary", "distributions"), main=True),
)
