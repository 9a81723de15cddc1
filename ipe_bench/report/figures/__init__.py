"""Figures: each module draws one kind of figure from an analysis."""

from __future__ import annotations

from collections.abc import Iterator

from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import house_style, looks
from ipe_bench.statistics.analysis import Analysis

__all__ = ["Drawing", "draw_all"]


def draw_all(analysis: Analysis) -> Iterator[Drawing]:
    """Every figure that the data allow, in the order of the report."""
    from ipe_bench.report.figures import (
        convergence,
        correlation,
        cost,
        distributions,
        error_scale,
        nees,
        profile_curves,
        ranks,
        success,
    )

    look = looks(analysis.collection.estimators)
    rooms = (error_scale, success, distributions, nees, convergence, cost, profile_curves, ranks, correlation)
    with house_style():
        for room in rooms:
            yield from room.draw(analysis, look)
