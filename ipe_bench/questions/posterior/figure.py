"""Draws marginals of a posterior beside the Gaussians of estimators."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ipe_bench.questions.panels import FARTHEST
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import looks_of
from ipe_bench.report.style import BOUND_COLOR

if TYPE_CHECKING:
    from ipe_bench.measurements.base import Measurement
    from ipe_bench.questions.posterior.maths import Reference


def draw_marginals(model: Measurement, found: Sequence[Reference]) -> Iterator[Drawing]:
    """Draws marginals of the first trial's posterior beside the Gaussians of estimators, the worst parameters."""
    one = found[0]
    mean, deviation, look = one.posterior.mean, one.posterior.deviation, looks_of(one.estimators)
    claims = {}
    for label, each in one.estimates.items():
        P = np.full((model.n, model.n), np.nan) if each.covariance is None else each.covariance[0]
        claims[label] = each.x[0], np.sqrt(np.diag(P))
    with np.errstate(all="ignore"):
        apart = [
            np.abs(x - mean) / deviation + np.abs(np.log(s / deviation)) for x, s in claims.values()
        ]
    worst = np.nan_to_num(np.max(apart, axis=0), nan=np.inf) if apart else np.zeros(model.n)
    chosen = np.sort(np.argsort(-worst, kind="stable")[: common.most_panels()])
    fig, axes = common.panels(len(chosen), look, height=2.4)
    for i, ax in zip(chosen, axes, strict=True):
        p = model.parameters[i]
        low, high = (p.size * (mean[i] + side * FARTHEST * deviation[i]) for side in (-1, 1))
        at, filled = (
            np.linspace(low, high, 300),
            {"color": BOUND_COLOR, "alpha": 0.25, "label": "posterior"},
        )
        ax.hist(p.size * one.posterior.x[:, i], bins=40, range=(low, high), density=True, **filled)
        for label, (x, s) in claims.items():
            value, width = p.size * x[i], p.size * s[i]
            line = {"color": look[label].color, "linestyle": look[label].line["linestyle"]}
            if width > 0 and np.isfinite(value):
                density = np.exp(-0.5 * ((at - value) / width) ** 2) / (width * np.sqrt(2 * np.pi))
                ax.plot(at, density, **line)
        ax.axvline(p.size * one.truth[i], color=BOUND_COLOR, linestyle=":", label="truth")
        ax.set_xlim(low, high)
        ax.set_yticks([])
        common.title(ax, f"{p.name} [{p.unit}]" if p.unit else p.name)
        common.full_ticks(ax)
    common.legend(fig, axes, {label: replace(each, marker="") for label, each in look.items()})
    more = (
        f", the {len(chosen)} parameters in which they differ most" if len(chosen) < model.n else ""
    )
    caption = f"Trial {one.trial}: draws of the posterior beside the Gaussians that estimators report{more}."
    yield Drawing("posterior", "Marginals", caption, fig)
