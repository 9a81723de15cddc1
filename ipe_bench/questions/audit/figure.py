"""Draws errors beside what is claimed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtri

from ipe_bench.questions.audit.maths import FARTHEST
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, BOUND_DASH, FAMILIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ipe_bench.basics.linalg import Array
    from ipe_bench.questions.audit.maths import Audit

MOST_POINTS = 300
"""Points of a panel; of more errors these quantiles are drawn, the extremes among them."""
_BENT = 30.0
"""Errors, in reported deviations, beyond which the axis is logarithmic at its ends."""


def draw_audit(found: Audit) -> Iterator[Drawing]:
    """Draws the quantiles of errors in reported standard deviations over those of the law that the
    report claims, for the worst parameters."""
    claims = found.claims
    apart = np.array([factor.apart for factor in found.each])
    worst = np.argsort(-apart, kind="stable")
    chosen = np.sort(worst[: common.most_panels()])
    fig, axes = common.panels(len(chosen), height=3.2)
    for i, ax in zip(chosen, axes, strict=True):
        expected, errors = quantiles(claims.z[:, i])
        _draw_quantiles(ax, expected, errors, found.each[i].value)
    named = [f"{claims.names[i]}: {_times(found.each[i].value)}" for i in chosen]
    common.titles(axes, named)
    common.axis_labels(fig, "quantile if reported right", "error / reported deviation")
    common.legend(fig, axes)
    caption = "Steeper than the dashed line: larger than reported. Bent at its ends: heavy tails."
    if len(chosen) < claims.n:
        caption += f" The {len(chosen)} of {claims.n} parameters farthest from 1."
    yield Drawing("audit", "Quantiles of errors against the reported law", caption, fig)


def _times(factor: float) -> str:
    if np.isfinite(factor):
        return f"{factor:.2f} times as reported"
    return "infinite errors" if factor > 1 else "few finite errors"


def quantiles(z: Array) -> tuple[Array, Array]:
    """Returns quantiles of the standard normal law and the errors z (rows,) that stand at them, in
    order; those that count as infinite count in the ranks alone."""
    errors = np.sort(z)
    rows = len(errors)
    expected = ndtri((np.arange(rows) + 0.5) / rows)
    even = np.linspace(expected[0], expected[-1], MOST_POINTS)
    shown = np.unique(np.searchsorted(expected, even).clip(max=rows - 1))
    if rows <= MOST_POINTS:
        shown = np.arange(rows)
    shown = shown[np.abs(errors[shown]) < FARTHEST]
    return expected[shown], errors[shown]


def _draw_quantiles(ax: Axes, expected: Array, errors: Array, factor: float) -> None:
    """Draws errors over their quantiles, with the lines on which they would be as large as reported
    and so many times as large."""
    if not len(errors):
        ax.set_axis_off()
        return
    ends = np.array([expected[0], expected[-1]])
    dashed: Any = {"color": BOUND_COLOR, "linestyle": BOUND_DASH}
    color = FAMILIES["filters"][0]
    ax.plot(ends, ends, label="as reported", zorder=3, **dashed)
    if np.isfinite(factor):
        ax.plot(ends, factor * ends, color=color, linewidth=1.0, label="so many times as large")
    point: Any = {"linestyle": "none", "markersize": 3.0, "color": FAMILIES["IPE"][0]}
    ax.plot(expected, errors, "o", label="errors", **point)
    if np.abs(errors).max() > _BENT:
        ax.set_yscale("symlog", linthresh=_BENT, linscale=1.0)
