"""Correlation of the parameters' errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.headline import best_of
from ipe_bench.report.style import REFERENCE
from ipe_bench.report.words import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh

MOST_PARAMETERS = 30
MOST_NUMBERED = 12
"""Parameters up to which the values stand in the cells."""
MIDDLE = 0.4
"""Luminance of cells from which on their numbers are dark."""


def draw(view: View) -> Iterator[Drawing]:
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
        mesh = _heatmap(ax, table, numbered=view.n <= MOST_NUMBERED)
        if label == list(tables)[-1]:
            fig.colorbar(mesh, ax=ax, label="correlation", shrink=0.8).outline.set_linewidth(0)
        # The first row and the last column are empty without the diagonal.
        ax.set(xlim=(0, view.n - 1), ylim=(view.n, 1))
        ax.set_title(f"{common.text(label)}, error scale {plain(scale)}, {solved[label]:.0f} trials")
    shown, table = next(iter(tables.items()))
    values = table.to_numpy()
    i, j = map(int, np.unravel_index(np.nanargmax(np.abs(np.tril(values, -1))), values.shape))
    caption = common.sentence(
        f"Correlation of the parameters' errors at error scale {plain(scale)} over solved trials:",
        f"{' beside '.join(tables)}. Strongest for {shown}: {table.index[i]} with {table.columns[j]},"
        f" {values[i, j]:.2f}. {view.label}.",
    )
    yield Drawing(f"correlation{view.suffix}", "Correlation of parameter errors", caption, fig)


def _heatmap(ax: Axes, table: pd.DataFrame, *, numbered: bool) -> QuadMesh:
    """The cells below the diagonal, with their values where there is room."""
    from matplotlib.colors import Normalize

    values = np.ma.masked_invalid(np.where(np.tri(len(table), k=-1, dtype=bool), table.to_numpy(), np.nan))
    mesh = ax.pcolormesh(values, cmap="RdBu_r", norm=Normalize(-1, 1), linewidths=0.5, edgecolors="white")
    places = np.arange(len(table)) + 0.5
    ax.set_xticks(places, table.columns, rotation=90)
    ax.set_yticks(places, table.index)
    ax.set_aspect("equal")
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    for i, j in zip(*np.nonzero(~np.ma.getmaskarray(values) & numbered), strict=True):
        light = _luminance(mesh.to_rgba(values[i, j])[:3]) > MIDDLE
        style = {"color": ".15" if light else "white", "ha": "center", "va": "center", "fontsize": 6.5}
        ax.text(float(places[j]), float(places[i]), _two_figures(float(values[i, j])), **style)
    return mesh


def _luminance(rgb: Any) -> float:
    """Relative luminance of a colour in sRGB (WCAG 2.1)."""
    c = np.asarray(rgb)
    return float(np.where(c <= 0.03928, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722))


def _table(rows: pd.DataFrame, label: str, view: View) -> pd.DataFrame:
    names = [p["name"] for p in view.parameters]
    table = rows[rows["estimator"] == label].pivot_table(index="row", columns="column", values="value")
    table = table.reindex(index=names, columns=names)
    labels = [common.text(name) for name in names]
    return table.set_axis(labels, axis=0).set_axis(labels, axis=1)


def _two_figures(value: float) -> str:
    """One decimal; never a minus before zero, and the sign that typography has."""
    return f"{value:.1f}".replace("-0.0", "0.0").replace("-", "\N{MINUS SIGN}")


FIGURE = Figure(draw, ("summary", "scores", "correlations"))
