"""How reported covariances lie: distribution functions of the truth under them, less those of honest ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import BOUND_COLOR, looks
from ipe_bench.report.words import plain
from ipe_bench.statistics.summary import ALL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINEAR = 0.1
"""Differences below this are drawn about in proportion, larger ones by their logarithm: honest curves differ by
hundredths, dishonest ones by up to 1."""


def draw(view: View) -> Iterator[Drawing]:
    rows = view["calibration"]
    if rows.empty:
        return
    yield _by_scale(view, rows[rows["parameter"] == ALL])
    yield _by_parameter(view, rows[rows["parameter"] != ALL])


def _by_scale(view: View, rows: pd.DataFrame) -> Drawing:
    """NEES of all estimators, a panel per error scale."""
    look = view.with_look(rows["estimator"])
    scales = common.spread(sorted(set(rows["error_scale"])))
    fig, axes = common.panels(len(scales), look)
    for scale, ax in zip(scales, axes, strict=True):
        part = common.at_scale(rows, scale)
        _axes(ax, part)
        common.lines(ax, part, "at", "difference", look, every=12)
        ax.set(title=f"error scale {plain(scale)}", xlabel="share under chi-square", ylabel="share seen less that")
    common.legend_below(fig, axes, look)
    each = view["summary"][view["summary"]["parameter"] == ALL].set_index(["error_scale", "estimator"])["calibration"]
    last = [f"{label}: {each[scales[-1], label]}" for label in look if (scales[-1], label) in each.index]
    caption = common.sentence(
        "NEES of the converged trials: the share of trials below each quantile of chi-square less the share that an"
        " honest covariance has there. Grey: what chance explains (simultaneous bands, in which all parameters and NEES"
        " of an honest estimator stay in 95 % of cases; light where fewer trials converged). Below 0 in the middle:"
        " deviations too small; above: too large.",
        f"At scale {plain(scales[-1])}, parameters included, {common.enumerate_few(last, 4)}. {view.label}.",
    )
    return Drawing(f"calibration{view.suffix}", "Calibration of the reported covariance", caption, fig)


def _by_parameter(view: View, rows: pd.DataFrame) -> Drawing:
    """Every parameter at the largest error scale, a panel per estimator; those inside their bands in grey."""
    rows = common.at_scale(rows, max(rows["error_scale"]))
    scale = plain(float(rows["error_scale"].iloc[0]))
    there = [label for label in view.look if label in set(rows["estimator"])]
    off = rows.groupby("estimator")["outside"].sum()
    # Those with something to see first; the order of the legend otherwise.
    shown = sorted(there, key=lambda label: -int(off[label] > 0))[: common.MOST_PANELS]
    colored = looks([str(p["name"]) for p in view.parameters])
    fig, axes = common.panels(len(shown), colored)
    for label, ax in zip(shown, axes, strict=True):
        part = rows[rows["estimator"] == label]
        _axes(ax, part)
        for name, curve in part.groupby("parameter", sort=False):
            look = colored[str(name)]
            style = {"color": look.color, "linestyle": look.linestyle, "linewidth": 1.5, "zorder": 3}
            grey = {"color": BOUND_COLOR, "linewidth": 0.6, "alpha": 0.5}
            outside = bool(curve["outside"].iloc[0])
            ax.plot(
                curve["at"],
                curve["difference"],
                label=common.text(name) if outside else "inside its bands",
                **(style if outside else grey),
            )
        ax.set(title=common.text(label), xlabel="share under the reported Gaussian", ylabel="share seen less that")
    common.legend_below(fig, axes)
    left_out = f" {len(there) - len(shown)} further estimators are in the table." if len(there) > len(shown) else ""
    caption = common.sentence(
        f"Error scale {scale}, each parameter by itself: the share of trials whose truth lies below each quantile of"
        " the Gaussian that the estimator reports, less the share that should. All above 0: the estimates lie too"
        " high; all below: too low; up, then down: deviations too small; down, then up: too large. Coloured:"
        f" parameters that surely are outside their bands, here or by the size of their errors.{left_out}",
        f"{view.label}.",
    )
    return Drawing(f"calibration_parameters{view.suffix}", "Calibration of each parameter", caption, fig)


def _axes(ax: Axes, rows: pd.DataFrame) -> None:
    """A panel with the widest and the narrowest band of these curves."""
    ax.set_yscale("asinh", linear_width=LINEAR / 2)
    reach = max(LINEAR, float(rows["difference"].abs().max()), float(rows[["low", "high"]].abs().max().max()))
    ticks: Sequence[float] = [t for t in (-1, -0.3, -0.1, -0.05, 0, 0.05, 0.1, 0.3, 1) if abs(t) <= 1.15 * reach]
    ax.set_ylim(-1.15 * reach, 1.15 * reach)
    ax.set_yticks(ticks, [plain(float(t)).replace("-", "\N{MINUS SIGN}") for t in ticks])
    ax.set_yticks([], minor=True)
    ax.set_xlim(0, 1)
    width = (rows["high"] - rows["low"]).groupby(rows["estimator"]).mean()
    for label, alpha in ((width.idxmax(), 0.12), (width.idxmin(), 0.15)):
        edge = rows[rows["estimator"] == label].drop_duplicates("at")
        ax.fill_between(edge["at"], edge["low"], edge["high"], color=BOUND_COLOR, alpha=alpha, linewidth=0, zorder=0)
    ax.axhline(0, color=BOUND_COLOR, linewidth=0.6, zorder=1)


FIGURE = Figure(draw, ("calibration", "summary"))
