"""Correlation of the parameters' errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.headline import best_of
from ipe_bench.report.style import REFERENCE
from ipe_bench.report.words import plain

MOST_PARAMETERS = 30
MOST_NUMBERED = 12
"""Parameters up to which the values stand in the cells."""


def draw(view: View) -> Iterator[Drawing]:
    import seaborn as sns

    if not 2 <= view.n <= MOST_PARAMETERS or view["correlations"].empty:
        return
    scale = view.scales[-1]
    best = best_of(view["scores"], view["summary"])
    rows = common.at_scale(view["correlations"], scale)
    tables = {label: _table(rows, label, view) for label in dict.fromkeys([best, REFERENCE])}
    tables = {label: table for label, table in tables.items() if np.isfinite(table.to_numpy()).any()}
    if not tables:
        return
    solved = common.at_scale(view.totals, scale).set_index("estimator")["solved_trials"]
    side = 1.3 + 0.3 * view.n
    fig = common.figure(min(10.0, (side + 0.6) * len(tables) + 0.6), min(5.2, side + 0.3))
    axes = list(fig.subplots(1, len(tables), squeeze=False).flat)
    for (label, table), ax in zip(tables.items(), axes, strict=True):
        style = {"vmin": -1, "vmax": 1, "cmap": "RdBu_r", "square": True, "linewidths": 0.5}
        if view.n <= MOST_NUMBERED:
            style |= {"annot": table.map(_two_figures), "fmt": "", "annot_kws": {"size": 6.5}}
        style |= {"cbar": label == list(tables)[-1], "cbar_kws": {"label": "correlation", "shrink": 0.8}}
        sns.heatmap(table, mask=np.triu(np.ones(table.shape, dtype=bool)), ax=ax, **style)
        # The first row and the last column are empty without the diagonal.
        ax.set(xlim=(0, view.n - 1), ylim=(view.n, 1), xlabel="", ylabel="")
        ax.set_title(f"{common.text(label)}, error scale {plain(scale)}, {solved[label]:.0f} trials")
        ax.tick_params(axis="x", rotation=90)
        ax.tick_params(axis="y", rotation=0)
    shown, table = next(iter(tables.items()))
    values = table.to_numpy()
    i, j = map(int, np.unravel_index(np.nanargmax(np.abs(np.tril(values, -1))), values.shape))
    caption = common.sentence(
        f"Correlation of the parameters' errors at error scale {plain(scale)} over solved trials:",
        f"{' beside '.join(tables)}. Strongest for {shown}: {table.index[i]} with {table.columns[j]},"
        f" {values[i, j]:.2f}. {view.label}.",
    )
    yield Drawing(f"correlation{view.suffix}", "Correlation of parameter errors", caption, fig)


def _table(rows: pd.DataFrame, label: str, view: View) -> pd.DataFrame:
    names = [p["name"] for p in view.parameters]
    table = rows[rows["estimator"] == label].pivot_table(index="row", columns="column", values="value")
    table = table.reindex(index=names, columns=names)
    labels = [common.text(name) for name in names]
    return table.set_axis(labels, axis=0).set_axis(labels, axis=1)


def _two_figures(value: float) -> str:
    """One decimal; never a minus before zero, and the sign that typography has."""
    return f"{value:.1f}".replace("-0.0", "0.0").replace("-", "\N{MINUS SIGN}")


FIGURE = Figure(draw, ("summary", "scores", "correlations"), weight=4.0)
