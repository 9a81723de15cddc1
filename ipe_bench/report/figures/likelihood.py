"""Profiles of the likelihood, of parameters for which they are not those of a linear model."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ipe_bench.real.examination import CONFIDENCE, Examination
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, house_style

MOST_PANELS = 9


def draw(found: Examination) -> Iterator[Drawing]:
    """A panel for each parameter whose interval from the standard error is off by more than a tenth."""
    names = found.model.physical_parameters
    bent = [i for i, one in enumerate(found.profiles) if one.bent][:MOST_PANELS]
    if not bent:
        return
    with house_style():
        across = {1: 1, 2: 2, 3: 3, 4: 2}.get(len(bent), 3)
        fig, axes = common.panels(len(bent), height=2.6, most_across=across)
        for i, ax in zip(bent, axes, strict=True):
            one, estimate, deviation = found.profiles[i], found.x[i], found.standard_errors[i]
            known = np.isfinite(one.zeta) & (np.abs(one.zeta) <= 2.5 * found.half_width)
            values = one.values[known]
            line = np.linspace(values[0], values[-1], 200)
            ax.plot(values, one.zeta[known] ** 2, marker="o", markersize=3, label="profile")
            parabola = ((line - estimate) / deviation) ** 2
            ax.plot(line, parabola, color=BOUND_COLOR, linewidth=0.8, label="standard error")
            common.bound_line(ax, found.half_width**2, f"limit of {CONFIDENCE:.0%}".replace("%", " %"))
            ax.set_ylim(0, 2.5 * found.half_width**2)
            unit = f" [{names[i].unit}]" if names[i].unit else ""
            ax.set_xlabel(common.text(f"{names[i].name}{unit}"))
            ax.set_ylabel("rise of chi-square")
        common.legend_below(fig, axes)
    told = "; ".join(f"{names[i].name} {found.profiles[i].low:.4g} to {found.profiles[i].high:.4g}" for i in bent)
    caption = (
        "How chi-square rises when one parameter is held and the others adapt to it, beside the parabola that a"
        f" standard error stands for. The interval is where the profile stays below the line: {told}."
    )
    yield Drawing("likelihood", "Profiles of the likelihood", caption, fig)
