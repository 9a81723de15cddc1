"""Correlation of the parameters' errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.headline import best_estimator
from ipe_bench.report.style import REFERENCE, Look
from ipe_bench.statistics.analysis import Analysis

MOST_PARAMETERS = 30


def draw(analysis: Analysis, look: Mapping[str, Look]) -> Iterator[Drawing]:
    parameters = {
        g.columns["measurement"]: [p["name"] for p in g.footer["parameters"]] for g in analysis.collection.groups
    }
    for setting in common.settings(analysis.scores, analysis.setting_columns):
        names = parameters[setting.rows["measurement"].iloc[0]]
        if not 2 <= len(names) <= MOST_PARAMETERS:
            continue
        scale = max(setting.scales)
        where = setting.scenario(scale)
        best = best_estimator(analysis, setting.rows)
        rows = analysis.correlations[analysis.correlations["scenario"] == where]
        n = len(names)
        tables = {
            e: rows.loc[rows["estimator"] == e, "value"].to_numpy().reshape(n, n)
            for e in dict.fromkeys([REFERENCE, best])
            if e in set(rows["estimator"])
        }
        tables = {e: t for e, t in tables.items() if np.isfinite(t).any()}
        if not tables:
            continue
        side = 1.3 + 0.3 * len(names)
        fig = common.figure(min(10.0, (side + 0.6) * len(tables) + 0.6), min(5.2, side + 0.3))
        axes = list(fig.subplots(1, len(tables), squeeze=False).flat)
        for i, ((label, table), ax) in enumerate(zip(tables.items(), axes, strict=True)):
            hidden = np.triu(np.ones_like(table, dtype=bool), 1)
            image = ax.imshow(np.ma.masked_where(hidden, table), vmin=-1, vmax=1, cmap="RdBu_r", aspect="equal")
            labels = [common.text(n) for n in names]
            ax.set_xticks(range(len(names)), labels)
            ax.set_yticks(range(len(names)), labels)
            if len(names) <= 12:
                for row, column in zip(*np.nonzero(~hidden), strict=True):
                    value = table[row, column]
                    dark = abs(value) > 0.6
                    ax.text(column, row, f"{value:.1f}", ha="center", va="center", size=6.5, color="w" if dark else "k")
            if i == len(tables) - 1:
                fig.colorbar(image, ax=ax, shrink=0.8, label="correlation")
            ax.tick_params(axis="x", rotation=90)
            ax.tick_params(axis="y", rotation=0)
            ax.grid(visible=False)
            ax.set_title(common.text(label))
        last = tables.get(best, next(iter(tables.values())))
        below = np.abs(np.tril(last, -1))
        i, j = np.unravel_index(int(np.nanargmax(below)), below.shape)
        caption = (
            f"Correlation of the parameters' errors at scale {common.plain(scale)} over solved trials: the linear"
            f" estimate beside {best} where both are there. Strongest for {best}: {names[i]} with {names[j]},"
            f" {last[i, j]:.2f}. {setting.label}."
        )
        yield Drawing(f"correlation{setting.suffix}", "Correlation of parameter errors", caption, fig)
