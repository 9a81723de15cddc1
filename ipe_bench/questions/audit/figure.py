"""Draws errors beside what is claimed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, FAMILIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ipe_bench.basics.linalg import Array
    from ipe_bench.questions.audit.maths import Audit


def draw_audit(found: Audit) -> Iterator[Drawing]:
    """Draws the errors in reported standard deviations beside the law that the report claims, the
    worst parameters."""
    claims = found.claims
    apart = [abs(np.log(max(factor.value, 1e-300))) for factor in found.each]
    worst = np.argsort(-np.array(apart), kind="stable")
    chosen = np.sort(worst[: common.most_panels()])
    fig, axes = common.panels(len(chosen), height=2.4)
    for i, ax in zip(chosen, axes, strict=True):
        _draw_errors(ax, claims.z[:, i])
        common.title(ax, f"{claims.names[i]}: {found.each[i].value:.2f} times")
    common.axis_labels(fig, "error / reported deviation", "")
    common.legend(fig, axes)
    caption = f"Errors beyond ±{common.FARTHEST:g} reported deviations stand at the edge."
    if len(chosen) < claims.n:
        caption += f" The {len(chosen)} of {claims.n} parameters farthest from 1."
    yield Drawing("audit", "Errors beside the reported covariance", caption, fig)


def _draw_errors(ax: Axes, z: Array) -> None:
    """Draws the histogram of the errors z (trials,) in reported standard deviations, and the
    standard normal density."""
    shown = np.clip(z, -common.FARTHEST, common.FARTHEST)
    ends = (-common.FARTHEST, common.FARTHEST)
    color = FAMILIES["IPE"][0]
    ax.hist(shown, bins=30, range=ends, density=True, color=color, alpha=0.45, label="errors")
    at = np.linspace(*ends, 300)
    claimed = np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi)
    ax.plot(at, claimed, color=BOUND_COLOR, linestyle="--", linewidth=1.0, label="as reported")
    ax.set_yticks([])
