"""Figures: each module draws one kind of figure from what it declares to read; `gallery` keeps a folder of them."""

from __future__ import annotations

from ipe_bench.report.figures.drawing import FORMATS, Drawing, Figure
from ipe_bench.report.figures.gallery import Drawn, draw_all

__all__ = ["FIGURES", "FORMATS", "Drawing", "Drawn", "Figure", "draw_all"]

FIGURES = (
    "headline",
    "errors",
    "costs",
    "data_profile",
    "parameters",
    "settings",
    "consistency",
    "convergence",
    "profiles",
    "correlation",
)
"""The modules, in the order of the report; a new figure is a module with a FIGURE, and its name here."""
