"""What accuracy costs: the error of each estimator against its simulations."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.errors import MOST, quantiles
from ipe_bench.report.figures.views import View
from ipe_bench.report.style import GREY
from ipe_bench.report.words import plain

LEAST_COST = 0.5
"""What does not simulate at all stands here: a logarithmic axis has no zero."""
_HIGHEST = 1e6
"""Errors beyond this many bounds stand at the upper edge."""


def draw(view: View) -> Iterator[Drawing]:
    import seaborn as sns

    rows = quantiles(view, MOST).merge(view["scores"][["error_scale", "estimator", "cost_median"]])
    rows = rows.assign(cost=rows["cost_median"].clip(lower=LEAST_COST), error=rows["error"].clip(upper=_HIGHEST))
    rows = rows[np.isfinite(rows["cost"])]
    if rows.empty:
        return
    look, scales = view.with_look(rows["estimator"]), common.spread(view.scales)
    fig, axes = common.panels(len(scales), look)
    style = {**common.seaborn_style(look), "edgecolor": "white", "linewidth": 0.6, "zorder": 3}
    # Equal points lie upon each other: the later ones are smaller, so that all are seen.
    areas = np.linspace(90, 40, len(look)) / (1 if common.most_panels() > 4 else 2)
    sizes = {
        label: a if look[label].color != GREY else 20.0 for label, a in zip(style["hue_order"], areas, strict=True)
    }
    for scale, ax in zip(scales, axes, strict=True):
        common.decades(ax, [*rows["error"], 1.0])
        here = common.at_scale(rows, scale)
        sns.scatterplot(here, x="cost", y="error", ax=ax, size="estimator", sizes=sizes, **style)
        common.bound_line(ax, 1.0, "Cramér-Rao bound")
        ax.set_xscale("log")
        ax.set_xlim(rows["cost"].min() / 1.5, rows["cost"].max() * 1.5)
        common.log_ticks(ax.xaxis, *ax.get_xlim())
        common.title(ax, f"error scale {plain(scale)}")
    common.axis_labels(fig, "simulations per trial (median)", "95 % error / efficient estimator's")
    common.legend(fig, axes, look)
    last = common.at_scale(rows, view.scales[-1])
    good = last[last["error"] <= last["error"].min() * 1.05].sort_values("cost_median", kind="stable").iloc[0]
    caption = common.sentence(
        "Median cost of a trial in simulations, a Jacobian counting what it costs, against what 95 % of all trials err"
        " by at most, over the same of an efficient estimator; down and left is better.",
        f"Errors beyond {common.power_of_ten(_HIGHEST)} stand at the edge." * bool((rows["error"] == _HIGHEST).any()),
        f"The cheapest within 5 % of the least error at scale {plain(view.scales[-1])}: {good['estimator']}"
        f" ({good['cost_median']:g} simulations). {view.label}.",
    )
    yield Drawing(f"cost_against_accuracy{view.suffix}", "Cost against accuracy, all trials", caption, fig)


FIGURES = (Figure(draw, ("summary", "distributions", "scores"), main=True),)
