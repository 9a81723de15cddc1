"""Room for the labels around panels, and for the legend below them, in a figure that has one grid of panels.

matplotlib's constrained layout comes to the same, and measures every label eight times, which takes longer than to
draw them. Here each is measured once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.layout_engine import ConstrainedLayoutEngine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_USUAL = {"left": 0.6, "right": 0.1, "top": 0.3, "bottom": 0.5}
"""Inches around a panel before anything is measured: near enough for the axes to have the ticks that they will have."""
_LEAST = 0.2
"""Part of the figure that the panels must have of its width and height; labels that leave less run out of it."""


class PanelLayout(ConstrainedLayoutEngine):
    """Panels of one grid with room for their labels: those of a column as wide as its ratio says, all rows of the same
    height. What has more to it, such as a color bar, is left to the constrained layout."""

    def execute(self, fig: Any) -> None:
        if not _is_plain(fig):
            super().execute(fig)
            return
        panels = fig.axes
        grid = _Grid.of(fig, self.get())
        grid.place({side: [inches * fig.dpi] * len(panels) for side, inches in _USUAL.items()})
        for _ in range(2):
            before = _ticks(panels)
            if not grid.place(_sides(fig, panels)) or _ticks(panels) == before:
                break


def _is_plain(fig: Any) -> bool:
    """Whether there is one grid of panels, each in a cell of its own shape, and nothing else but legends below them."""
    specs = [ax.get_subplotspec() for ax in fig.axes]
    return (
        bool(specs)
        and all(spec is not None and spec.get_gridspec() is specs[0].get_gridspec() for spec in specs)
        and all(len(spec.rowspan) == len(spec.colspan) == 1 for spec in specs)
        and len(set(specs[0].get_gridspec().get_height_ratios())) == 1
        and all(ax.get_aspect() == "auto" for ax in fig.axes)
        and all(getattr(legend, "_outside_loc", None) == "lower" for legend in fig.legends)
        and not (fig.get_suptitle() or fig.get_supxlabel() or fig.get_supylabel() or fig.subfigs)
    )


def _ticks(panels: Sequence[Axes]) -> list[tuple[float, ...]]:
    """Where the labels are: axes of another length may have others."""
    return [tuple(axis.get_majorticklocs()) for ax in panels if ax.axison for axis in (ax.xaxis, ax.yaxis)]


def _sides(fig: Figure, panels: Sequence[Axes]) -> dict[str, list[float]]:
    """How far the labels of each panel reach beyond it, in pixels."""
    renderer = fig.canvas.get_renderer()  # type: ignore[attr-defined]
    found: dict[str, list[float]] = {side: [] for side in _USUAL}
    for ax in panels:
        box = ax.bbox
        all_of_it = ax.get_tightbbox(renderer, for_layout_only=True) if ax.axison else None
        outer = box if all_of_it is None else all_of_it
        found["left"].append(box.x0 - outer.x0)
        found["right"].append(outer.x1 - box.x1)
        found["bottom"].append(box.y0 - outer.y0)
        found["top"].append(outer.y1 - box.y1)
    return found


@dataclass(frozen=True)
class _Grid:
    """The places of panels in a figure, in pixels."""

    panels: Sequence[Axes]
    size: tuple[float, float]
    ratios: Any
    """Of the columns' widths; they come to 1."""
    row: Any
    """Of each panel, from the top."""
    column: Any
    pad: tuple[float, float]
    """Beside and above everything."""
    gap: tuple[float, float]
    """The least between neighbours."""
    legend: float
    """Height below all panels."""

    @classmethod
    def of(cls, fig: Figure, spaces: Mapping[str, float]) -> _Grid:
        specs = [ax.get_subplotspec() for ax in fig.axes]
        gridspec = specs[0].get_gridspec()  # type: ignore[union-attr]
        ratios = np.array(gridspec.get_width_ratios(), dtype=float)
        width, height = fig.bbox.width, fig.bbox.height
        pad = spaces["w_pad"] * fig.dpi, spaces["h_pad"] * fig.dpi
        renderer = fig.canvas.get_renderer()  # type: ignore[attr-defined]
        legends = [legend.get_window_extent(renderer).height + 2 * pad[1] for legend in fig.legends]
        return cls(
            fig.axes,
            (width, height),
            ratios / ratios.sum(),
            np.array([spec.rowspan.start for spec in specs]),  # type: ignore[union-attr]
            np.array([spec.colspan.start for spec in specs]),  # type: ignore[union-attr]
            pad,
            (spaces["wspace"] * width / 2 / gridspec.ncols, spaces["hspace"] * height / 2 / gridspec.nrows),
            max(legends, default=0.0),
        )

    def place(self, sides: dict[str, list[float]]) -> bool:
        """Places the panels with that much around each; not where that would leave them next to nothing."""
        columns, rows = len(self.ratios), int(self.row.max()) + 1
        left, right = (self._widest(sides[side], self.column, columns) for side in ("left", "right"))
        top, bottom = (self._widest(sides[side], self.row, rows) for side in ("top", "bottom"))
        for first, second, axis in ((right, left, 0), (bottom, top, 1)):
            first += self.pad[axis]
            second += self.pad[axis]
            first[:-1] += max(0.0, self.gap[axis] - self.pad[axis])
            second[1:] += max(0.0, self.gap[axis] - self.pad[axis])
        width = self.size[0] - (left + right).sum()
        height = (self.size[1] - self.legend - (top + bottom).sum()) / rows
        if width < _LEAST * self.size[0] or height * rows < _LEAST * self.size[1]:
            return False
        widths = width * self.ratios
        x = np.cumsum(left) + np.cumsum(right) - right + np.cumsum(widths) - widths
        y = self.size[1] - np.cumsum(top) - np.cumsum(bottom) + bottom - height * np.arange(1, rows + 1)
        for ax, i, j in zip(self.panels, self.row, self.column, strict=True):
            ax.set_position((x[j] / self.size[0], y[i] / self.size[1], widths[j] / self.size[0], height / self.size[1]))
        return True

    @staticmethod
    def _widest(values: list[float], which: Any, count: int) -> Any:
        found = np.zeros(count)
        np.maximum.at(found, which, values)
        return found
