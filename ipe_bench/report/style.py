"""The look of an estimator, the same in every figure: a colour, a marker and a dash that can be told apart in grey."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

# Okabe and Ito's palette (Color Universal Design, 2008), its yellow and black replaced by colours that show on white
# paper; ordered so that neighbours differ in lightness too. The last five are those farthest from all before in OKLab,
# the smallest distance over normal, protanopic and deuteranopic sight (Machado et al., 2009).
COLORS = (
    "#0072B2",
    "#E69F00",
    "#D55E00",
    "#56B4E9",
    "#009E73",
    "#CC79A7",
    "#882255",
    "#777777",
    "#332288",
    "#785A00",
    "#D200B4",
    "#96B487",
    "#6900FF",
    "#1E4B00",
)
BLACK, WHITE = "#000000", "#ffffff"
_LIFTED = (
    "#52acf0",
    "#fec365",
    "#ff965e",
    "#90d4ff",
    "#53cfa1",
    "#f7a1d0",
    "#d46897",
    "#ababab",
    "#7673de",
    "#b7974f",
    "#ff70e0",
    "#b7d6a8",
    "#998dfe",
    "#659551",
)
ON_DARK: dict[str, str] = dict(zip((*COLORS, BLACK), (*_LIFTED, WHITE), strict=True))
"""The same colours where the ground is dark: of the same hue in OKLab, with a lightness of 0.6 + 0.4 of theirs."""
MARKERS = ("o", "s", "D", "^", "v", "P", "d", "<", ">", "p", "h")
DASHES: tuple[Any, ...] = ("", (5, 2), (1, 1.5), (5, 2, 1, 2))
"""As seaborn and matplotlib take them: lengths on and off, nothing for a solid line."""
REFERENCE = "linear_lse"
"""The estimator that others are held against: black and crossed, whoever else is there."""
BOUND_COLOR = "#444444"
BOUND_DASH = (0, (2, 2))


@dataclass(frozen=True)
class Look:
    """How one estimator is drawn."""

    color: str
    marker: str
    dash: Any = ""

    @property
    def linestyle(self) -> Any:
        return (0, self.dash) if self.dash else "-"

    @property
    def line(self) -> dict[str, Any]:
        """Arguments of a line with markers."""
        return {
            "color": self.color,
            "marker": self.marker,
            "linestyle": self.linestyle,
            "markersize": 5.5,
            "markeredgecolor": "white",
            "markeredgewidth": 0.6,
            "linewidth": 1.6,
        }


def looks(labels: Sequence[str]) -> dict[str, Look]:
    """A look per label. 14 colours come before one is repeated, then with another dash and another marker; 11 markers
    and 14 colours have no common divisor, so that 616 labels differ."""
    rest = [label for label in labels if label != REFERENCE]
    result = {
        label: Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)], DASHES[(i // len(COLORS)) % len(DASHES)])
        for i, label in enumerate(rest)
    }
    result[REFERENCE] = Look(BLACK, "X", (5, 2))
    return {label: result[label] for label in labels}


_WHITEGRID: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelcolor": ".15",
    "axes.linewidth": 1.0,
    "font.size": 10.08,
    "legend.title_fontsize": 10.08,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.8,
    "lines.solid_capstyle": "round",
    "patch.edgecolor": "w",
    "patch.force_edgecolor": True,
    "patch.linewidth": 0.8,
    "text.color": ".15",
    **{
        f"{axis}tick.{name}": value
        for axis in "xy"
        for name, value in (
            ("color", ".15"),
            ("major.size", 4.8),
            ("major.width", 1.0),
            ("minor.size", 3.2),
            ("minor.width", 0.8),
        )
    },
    "xtick.bottom": False,
    "ytick.left": False,
}
"""seaborn's white grid in its context of a paper with letters 1.05 times as large: its numbers, since to ask it for
them takes as long as to draw five figures."""
_HOUSE: dict[Any, Any] = _WHITEGRID | {
    "font.family": "DejaVu Sans",
    "font.sans-serif": ["DejaVu Sans"],
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.edgecolor": "#888888",
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "pdf.fonttype": 42,
    "svg.hashsalt": "ipe-bench",
}
_TITLES: dict[Any, Any] = {"axes.titley": 1.0}
"""Directly above the panel: to look for what a title might run into takes longer than to write it."""


@contextmanager
def house_style() -> Iterator[None]:
    """Fonts, grid and sizes of all figures."""
    import matplotlib as mpl

    with mpl.rc_context(_HOUSE):
        yield


@contextmanager
def report_style() -> Iterator[None]:
    """That of the report's own figures, whose axes have no multiplier above them that a title could run into."""
    import matplotlib as mpl

    with house_style(), mpl.rc_context(_TITLES):
        yield


PRINT: dict[Any, Any] = {
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "legend.fontsize": 7,
    "legend.columnspacing": 1.0,
    "legend.handlelength": 1.6,
    "legend.handletextpad": 0.4,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "lines.linewidth": 1.0,
    "axes.titlepad": 3.0,
    "axes.labelpad": 2.0,
    "xtick.major.pad": 2.0,
    "ytick.major.pad": 2.0,
    "figure.constrained_layout.w_pad": 0.02,
    "figure.constrained_layout.h_pad": 0.02,
    "figure.dpi": 300,
    "savefig.dpi": 300,
}
"""Sizes in a column of print, where nothing is scaled any more: 7 to 8 points are as IEEE's."""


@contextmanager
def print_style() -> Iterator[None]:
    """The same look in the sizes of print."""
    import matplotlib as mpl

    with house_style(), mpl.rc_context(_TITLES | PRINT):
        yield
