"""Draws errors beside what is claimed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ipe_bench.questions.panels import FARTHEST
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, FAMILIES

if TYPE_CHECKING:
    from ipe_bench.questions.audit.maths import Audit


def draw_audit(found: Audit) -> Iterator[Drawing]:
    """Draws the errors in reported standard deviations beside the law that the report claims, the worst parameters."""
    claims, n = found.claims, found.claims.n
    worst = np.argsort([-abs(np.log(max(f.value, 1e-300))) for f in found.each], kind="stable")
    chosen = np.sort(worst[: common.most_panels()])
    fig, axes = common.panels(len(chosen), height=2.4)
    at = np.linspace(-FARTHEST, FARTHEST, 300)
    for i, ax in zip(chosen, axes, strict=True):
        values = np.clip(claims.z[:, i], -FARTHEST, FARTHEST)
        style = {"color": FAMILIES["IPE"][0], "alpha": 0.45, "label": "errors"}
        ax.hist(values, bins=30, range=(-FARTHEST, FARTHEST), density=True, **style)
        claimed = np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi)
        ax.plot(at, claimed, color=BOUND_COLOR, linestyle="--", linewidth=1.0, label="as reported")
        ax.set_yticks([])
        common.title(ax, f"{claims.names[i]}: {found.each[i].value:.2f} times")
    common.axis_labels(fig, "error / reported deviation", "")
    common.legend(fig, axes)
    more = f" The {len(chosen)} of {n} parameters farthest from 1." if len(chosen) < n else ""
    caption = f"Errors beyond ±{FARTHEST:g} reported deviations stand at the edge.{more}"
    yield Drawing("audit", "Errors beside the reported covariance", caption, fig)
