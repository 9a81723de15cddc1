"""Distribution of the trials' errors, held against that of an efficient estimator."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import gammainc, gammaincinv

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH
from ipe_bench.report.words import plain
from ipe_bench.trials.thresholds import GATE


def draw(view: View) -> Iterator[Drawing]:
    frame = view["distributions"]
    if frame.empty:
        return
    look = view.with_look(frame["estimator"])
    rows = frame.assign(error=frame["distance"] / np.sqrt(view.n))
    rows = rows[np.isfinite(rows["error"]) & (rows["error"] > 0)]
    scales = common.spread(view.scales)
    fig, axes = common.panels(len(scales), look)
    # The law of an efficient estimator's error: chi with n degrees.
    x = np.geomspace(_chi_quantile(0.001, view.n), _chi_quantile(0.9999, view.n), 200)
    for scale, ax in zip(scales, axes, strict=True):
        band = {"color": BOUND_COLOR, "linewidth": 7, "alpha": 0.2, "label": "efficient (chi)"}
        ax.plot(x / np.sqrt(view.n), gammainc(view.n / 2, x**2 / 2), **band)
        here = common.at_scale(rows, scale)
        low, high = here["error"].min(), here["error"].max()
        ax.set_xscale("log")
        ax.set_xlim(min(low, 0.5) / 1.2, max(high, 2.5) * 1.2)
        common.lines(ax, here, "error", "probability", look, every=24)
        gate = _chi_quantile(1 - GATE, view.n) / np.sqrt(view.n)
        ax.axvline(gate, color=BOUND_COLOR, linestyle=BOUND_DASH, linewidth=1.0, label="gate of success")
        common.log_ticks(ax.xaxis, *ax.get_xlim())
        common.shares(ax, "share of trials below")
        ax.set(title=f"error scale {plain(scale)}", xlabel="Mahalanobis error / √n")
    common.legend_below(fig, axes, look)
    last = common.at_scale(frame, view.scales[-1])
    medians = last[last["probability"] == 0.5].assign(median=last["distance"] / np.sqrt(view.n))
    caption = common.sentence(
        "Share of all trials whose Mahalanobis error (in standard deviations of the Cramér-Rao bound, over the root of"
        " the number of parameters) is below the abscissa; grey band: an efficient estimator; curves that end below one"
        " belong to estimators some of whose estimates are not finite.",
        f"Medians at scale {plain(view.scales[-1])}: {common.values_of(medians, 'median')}. {view.label}.",
    )
    yield Drawing(f"error_distributions{view.suffix}", "Distribution of errors", caption, fig)


def _chi_quantile(p: float, n: int) -> float:
    return float(np.sqrt(2 * gammaincinv(n / 2, p)))


FIGURE = Figure(draw, ("distributions",))
