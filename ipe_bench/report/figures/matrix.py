"""Draws the matrix of a sweep for files and papers; a page shows it as a table."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.finding import Finding
from ipe_bench.report.style import RAMP, WHITE, print_width
from ipe_bench.report.tables.matrix import MATRIX, Tile, matrices

WIDTH = 5.0
"""Inches: 750 pixels, the width of a text on GitHub."""
_ROW = 0.24
"""Inches of a row, in the width of a page."""
_HEAD = 0.9
"""Inches of what stands above and below the rows, in the width of a page."""
_LETTERS = 13
"""Letters of the title to an inch."""


def draw(view: View) -> Iterator[Drawing]:
    from matplotlib.figure import Figure as Canvas

    rows: Any = view.totals.to_dict("records")
    if len(view.scales) < 2:
        return
    (matrix,) = matrices(rows)
    columns = matrix.folded().columns
    names = [cell.text for cell in columns[0].cells]
    tiles: list[list[Any]] = [list(row[1:]) for row in matrix.folded().rows]
    width = print_width() or WIDTH
    small = width / WIDTH
    finding = textwrap.fill(Finding.of(rows).sentence(), int(_LETTERS * WIDTH))
    height = _HEAD + _ROW * len(names) + 0.16 * finding.count("\n")
    figure = Canvas(figsize=(width, small * height), layout="constrained")
    ax = figure.subplots()
    steps = [[_step(tile) for tile in row] for row in tiles]
    words = [[_text(tile) for tile in row] for row in tiles]
    common.tiles(
        ax,
        steps,
        [*RAMP, WHITE],
        words,
        7.5 * small,
        linewidths=1.0,
        linecolor="white",
        xticklabels=[column.title for column in columns[1:]],
        yticklabels=names,
    )
    ax.xaxis.tick_top()
    ax.xaxis.set_label_position("top")
    ax.set_xlabel(matrix.over, fontsize=7.5 * small)
    ax.tick_params(length=0, labelsize=7.5 * small, labelrotation=0)
    for label, cell in zip(ax.get_yticklabels(), columns[0].cells, strict=True):
        label.set_fontweight(cell.style or "normal")
    figure.suptitle(finding, x=0.01, ha="left", fontsize=8.5 * small, fontweight="bold")
    yield view.drawing(figure, MATRIX, "Success", *matrix.captions)


def _text(tile: Tile) -> str:
    """Returns number and sign, a hair apart."""
    return f"{tile.number}\u2009{tile.sign}".strip() or tile.text


def _step(tile: Tile) -> int:
    return len(RAMP) if tile.step is None else tile.step


FIGURES = (Figure(draw, ("summary",), main=True),)
