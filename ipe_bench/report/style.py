"""Chooses a report's figures, their files and their looks: a colour family per kind of estimator, a marker and a dash
per member, one theme."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from ipe_bench.basics.errors import UserError

Which = Literal["all", "main", "none"]
"""All figures that the data allow, the few that answer the question, or none."""
PAGE = "png"
"""The format that is always written, as the page shows it."""
FIGURES = (PAGE, "pdf", "svg")
"""Formats of figures."""
TABLES = ("csv", "md", "tex")
"""Formats of tables: the first is always written."""
FORMATS = (*FIGURES, *TABLES)
FAMILIES: dict[str, tuple[str, ...]] = {
    "IPE": ("#08519c", "#4292c6", "#08a1b8", "#5e4fd0", "#7fb2e5"),
    "filters": ("#d94801", "#fd9a4e", "#8c2d04", "#e31a3c", "#e6ab02"),
    "least squares": ("#1b7837", "#5aae61", "#00441b", "#8a9a1b", "#9bd19b"),
    "ensembles": ("#6a1b9a", "#b07cc6", "#c2188f", "#f07fc0"),
}
"""Colours by kind of estimator, neighbours differing in lightness; all of them are told apart on white and in print."""
COLORS = tuple(family[i] for i in range(5) for family in FAMILIES.values() if i < len(family))
"""Colours of the families by turns, for parameters and settings."""
BLACK, GREY = "#000000", "#b0b0b0"
MARKERS = ("o", "s", "D", "^", "v", "P", "d", "<", ">", "p", "h")
DASHES: tuple[Any, ...] = ("", (5, 2), (1, 1.5), (5, 2, 1, 2))
"""Dash patterns as seaborn and matplotlib read them: lengths on and off, empty for a solid line."""
REFERENCE = "linear_lse"
"""Label of the reference estimator: black and crossed in every figure."""
BOUND_COLOR, BOUND_DASH = "#444444", (0, (2, 2))
MOST_FACES = 10
"""Estimators up to which each has a colour; of more, `chosen` ones have, and the others are grey."""


def which_figures(asked: Any) -> Which:
    """Returns the choice of this name; raises UserError if there is none."""
    if asked not in get_args(Which):
        raise UserError(f"figures={asked}: choose all, main or none")
    return cast(Which, asked)


def file_formats(asked: Any) -> tuple[str, ...]:
    """Returns the formats asked for, in one word or several, with those that are always written; raises UserError if
    one is unknown."""
    words = asked if isinstance(asked, Sequence) and not isinstance(asked, str) else str(asked).strip("[]").split(",")
    names = [str(word).strip() for word in words]
    if not names or not set(names) <= set(FORMATS):
        raise UserError(f"formats={','.join(names)}: choose among {', '.join(FORMATS[:-1])} and {FORMATS[-1]}")
    return tuple(kind for kind in FORMATS if kind in {PAGE, TABLES[0], *names})


@dataclass(frozen=True)
class Look:
    """How one estimator is drawn."""

    color: str
    marker: str
    dash: Any = ""

    @property
    def line(self) -> dict[str, Any]:
        """Arguments of a line with markers."""
        dashes = (0, self.dash) if self.dash else "-"
        return {"color": self.color, "marker": self.marker, "linestyle": dashes, "markeredgecolor": "white"}


def looks(
    labels: Sequence[str], kinds: Mapping[str, str] | None = None, chosen: Sequence[str] | None = None
) -> dict[str, Look]:
    """Returns a look per label: of its kind's family if `kinds` gives one, grey if it is not among those `chosen`.

    11 markers and 4 dashes have a common period of 44; with the colours hundreds of labels differ.
    """
    counts: dict[str, int] = {}
    found = {REFERENCE: Look(BLACK, "X", (5, 2))}
    for i, label in enumerate(label for label in labels if label != REFERENCE):
        kind = (kinds or {}).get(label, "")
        family = FAMILIES.get(kind, COLORS)
        k = counts[kind] = counts.get(kind, -1) + 1
        color = family[k % len(family)] if chosen is None or label in chosen else GREY
        dash = list(FAMILIES).index(kind) if kind in FAMILIES else i // 11
        found[label] = Look(color, MARKERS[i % len(MARKERS)], DASHES[(dash + k // len(family)) % len(DASHES)])
    return {label: found[label] for label in labels}


_HOUSE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "legend.frameon": False,
    "axes.edgecolor": "#888888",
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "lines.markersize": 5.0,
    "lines.markeredgewidth": 0.5,
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "pdf.fonttype": 42,
    "svg.hashsalt": "ipe-bench",
}
_PRINT: dict[str, Any] = {
    "legend.columnspacing": 1.0,
    "legend.handlelength": 1.6,
    "legend.handletextpad": 0.4,
    "axes.titlepad": 3.0,
    "axes.labelpad": 2.0,
    "lines.linewidth": 1.0,
    "lines.markersize": 3.4,
    "figure.constrained_layout.w_pad": 0.02,
    "figure.constrained_layout.h_pad": 0.02,
    "figure.dpi": 300,
    "savefig.dpi": 300,
}
_print_width: ContextVar[float] = ContextVar("print_width", default=0.0)


def print_width() -> float:
    """Returns the width in inches of the column of print that figures are drawn for; 0 for those of the page."""
    return _print_width.get()


@contextmanager
def house_style(scale: float = 0.95, more: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Sets seaborn's white grid in its context of a paper, with letters of this scale."""
    import matplotlib as mpl
    import seaborn as sns

    settings: dict[Any, Any] = {**sns.axes_style("whitegrid"), **sns.plotting_context("paper", font_scale=scale)}
    settings |= {**_HOUSE, **(more or {})}
    with mpl.rc_context(settings):
        yield


@contextmanager
def print_style(width: float) -> Iterator[None]:
    """Sets the same look in a column of print, which is not scaled any more: letters of 7 points, as IEEE's."""
    token = _print_width.set(width)
    try:
        with house_style(0.74, _PRINT):
            yield
    finally:
        _print_width.reset(token)
