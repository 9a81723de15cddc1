"""Errors of all trials: against the error scale, in decades and near the bound, and their distributions."""

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
from ipe_bench.report.words import plain
from ipe_bench.trials.thresholds import GATE

NEAR = 2.0
"""Panels that zoom on the bound show errors up to this multiple of it."""
HALF, MOST = 0.5, 0.95
"""Shares of the trials whose errors lie below what is drawn."""


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
        for ax, shown in ((wide, rows), (near, close)):
            common.curves(ax, shown, "error", look, view.scales, interval=("low", "high"))
            common.bound_line(ax, 1.0, "Cramér-Rao bound")
        common.title(wide, f"{name} of all trials")
        common.title(near, f"{name}, near the bound")
    common.axis_labels(fig, "error scale" if several else "", "error / efficient estimator's")
    common.legend(fig, axes, look)
    last = common.at_scale(quantiles(view, MOST), view.scales[-1])
    caption = common.sentence(
        "Mahalanobis error of all trials, those that failed included, over that of an efficient estimator: median"
        " above, 95 % quantile below; decades left, and right the same near the bound, up to"
        f" {plain(NEAR)}. Bars: 95 % intervals by order statistics.",
        f"95 % of the trials at scale {top} err by less than, in bounds:"
        f" {common.values_of(last, 'error') or 'no finite number'}. {view.label}.",
    )
    title = "Error against error scale" if several else f"Error at error scale {top}"
    yield Drawing(f"error_against_scale{view.suffix}", f"{title}, all trials", caption, fig)


def draw_distributions(view: View) -> Iterator[Drawing]:
    frame = view["distributions"].assign(error=view["distributions"]["distance"] / np.sqrt(view.n))
    if frame.empty:
        return
    rows = frame[np.isfinite(frame["error"]) & (frame["error"] > 0)]
    look, scales = view.with_look(frame["estimator"]), common.spread(view.scales)
    fig, axes = common.panels(len(scales), look)
    x = np.geomspace(efficient(0.001, view.n), efficient(0.9999, view.n), 200)
    gate = efficient(1 - GATE, view.n) / np.sqrt(view.n)
    for scale, ax in zip(scales, axes, strict=True):
        band = {"color": BOUND_COLOR, "linewidth": 4, "alpha": 0.25, "label": "efficient estimator (chi)"}
        ax.plot(x / np.sqrt(view.n), gammainc(view.n / 2, x**2 / 2), **band)
        here = common.at_scale(rows, scale)
        ends = min(here["error"].min(), 0.5) / 1.2, max(here["error"].max(), 2.5) * 1.2
        common.steps(ax, here, "error", "probability", look, *ends)
        ax.axvline(gate, color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0, label="gate of success")
        common.title(ax, f"error scale {plain(scale)}")
    common.axis_labels(fig, "Mahalanobis error / √n", "share of all trials below")
    common.legend(fig, axes, look)
    last = common.at_scale(frame, view.scales[-1])
    caption = common.sentence(
        "Share of all trials whose Mahalanobis error (in standard deviations of the Cramér-Rao bound, over the root of"
        " the number of parameters) is below the abscissa; a curve that ends below 100 % belongs to an estimator some"
        " of whose estimates are not finite.",
        f"Medians at scale {plain(view.scales[-1])}:"
        f" {common.values_of(last[last['probability'] == HALF], 'error')}. {view.label}.",
    )
    yield Drawing(f"error_distributions{view.suffix}", "Distribution of errors, all trials", caption, fig)


FIGURES = (
    Figure(draw_against_scale, ("summary", "distributions"), main=True),
    Figure(draw_distributions, ("summary", "distributions"), main=True),
)
