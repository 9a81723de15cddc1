"""Correlation of the parameters' errors, beside that of the bound."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.words import plain
from ipe_bench.statistics.summary import ALL

MOST_PARAMETERS = 30
MOST_NUMBERED = 12
"""Parameters up to which the values stand in the cells."""

NEAR = 0.005
"""Capped errors within this part of the smallest count as equally good."""


def draw(view: View) -> Iterator[Drawing]:
    import seaborn as sns

    if not 2 <= view.n <= MOST_PARAMETERS or view["correlations"].empty:
        return
    scale = view.scales[-1]
    best = _best_of(view["scores"], view["summary"])
    rows = common.at_scale(view["correlations"], scale)
    table = _table(rows[rows["estimator"] == best], view)
    if not np.isfinite(table.to_numpy()).any():
        return
    solved = common.at_scale(view.totals, scale).set_index("estimator")["solved_trials"][best]
    tables = {f"{best}, error scale {plain(scale)}, {solved:.0f} solved trials": table}
    if view.bound_correlation is not None:
        tables["linear bound, eq. (5)"] = pd.DataFrame(view.bound_correlation, table.index, table.columns)
    side, narrow = 1.2 + 0.36 * view.n, common.most_panels() <= 4
    # Side by side on the page, one below the other in a column of print.
    across, down = (1, len(tables)) if narrow else (len(tables), 1)
    fig = common.figure(min(11.0, (side + 0.4) * across + 0.6), min(5.4, side + 0.3) * down)
    axes = list(fig.subplots(down, across, squeeze=False).flat)
    numbered = view.n <= MOST_NUMBERED and not narrow
    for (title, one), ax in zip(tables.items(), axes, strict=True):
        hidden = ~np.tri(view.n, k=-1, dtype=bool)
        cells = one.map(two_decimals) if numbered else False
        style: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -1, "vmax": 1, "square": True, "linewidths": 0.5}
        sns.heatmap(one, ax=ax, mask=hidden, annot=cells, fmt="", annot_kws={"fontsize": 6}, cbar=False, **style)
        # The first row and the last column are empty without the diagonal.
        ax.set(xlim=(0, view.n - 1), ylim=(view.n, 1), xlabel="", ylabel="")
        ax.tick_params(axis="x", labelrotation=90)
        ax.tick_params(axis="y", labelrotation=0)
        ax.grid(visible=False)
        common.title(ax, title)
    fig.colorbar(axes[0].collections[0], ax=axes, label="correlation", shrink=0.8).outline.set_linewidth(0)
    values = np.abs(np.tril(table.to_numpy(), -1))
    i, j = map(int, np.unravel_index(np.nanargmax(values), values.shape))
    caption = common.sentence(
        f"Correlation of the parameters' errors of {best} at error scale {plain(scale)} over its solved trials"
        + (", beside that of the linear bound." if len(tables) > 1 else "."),
        f"Strongest: {table.index[i]} with {table.columns[j]}, {table.iloc[i, j]:.2f}. {view.label}.",
    )
    yield Drawing(f"correlation{view.suffix}", "Correlation of parameter errors, solved trials", caption, fig)


def _table(rows: pd.DataFrame, view: View) -> pd.DataFrame:
    names = [p["name"] for p in view.parameters]
    table = rows.pivot_table(index="row", columns="column", values="value").reindex(index=names, columns=names)
    labels = [common.text(name) for name in names]
    return table.set_axis(labels, axis=0).set_axis(labels, axis=1)


def two_decimals(value: float) -> str:
    """0.97 as .97; never a minus before zero, and the sign that typography has."""
    words = f"{value:.2f}".replace("-0.00", "0.00").replace("0.", ".")
    return words.replace("-", "\N{MINUS SIGN}") if np.isfinite(value) else ""


def _best_of(scores: pd.DataFrame, summary: pd.DataFrame) -> str:
    """The estimator with the smallest mean capped error over the scenarios that most estimators have.

    Of those within `NEAR` of it the one that succeeds most, and of those the cheapest. Both frames are of the same
    scenarios and estimators, in the same order.
    """
    success = summary.loc[summary["parameter"] == ALL, "success"].to_numpy()
    scores = scores.assign(success=success)
    counts = scores.groupby("estimator", sort=False).size()
    scores = scores[scores["estimator"].isin(counts.index[counts == counts.max()])]
    means = scores.groupby("estimator", sort=False)[["capped_error", "success", "cost_median"]].mean()
    means = means[means["capped_error"] <= means["capped_error"].min() * (1 + NEAR)]
    means = means[means["success"] >= means["success"].max() - 1e-9]
    return str(means.index[int(np.argmin(means["cost_median"].to_numpy()))])


FIGURE = Figure(draw, ("summary", "scores", "correlations"))
