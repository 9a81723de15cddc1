"""Chooses a report's figures, their files and their looks: a colour family per kind of estimator, a
marker and a dash per member, one theme."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, Literal, cast, get_args
from zlib import crc32

from ipe_bench.basics.errors import UserError
from ipe_bench.report.formats import FORMATS, PAGE, TABLES

Which = Literal["all", "main", "none"]
"""All figures that the data allow, the few that answer the question, or none."""
MOST_SETTINGS = 6
"""Settings up to which all have figures of their own."""
FIRST_SETTINGS = 2
"""Settings that have figures where there are more, unless all figures are asked for."""
FAMILIES: dict[str, tuple[str, ...]] = {
    "IPE": ("#0f7f8f", "#86a9e0", "#5b76b8", "#3648c9"),
    "filters": ("#8c2d04", "#c08a00", "#c2273d", "#f08a6c"),
    "least squares": ("#1b7837", "#5aae61", "#00441b", "#8a9a1b"),
    "ensembles": ("#c2188f", "#b07cc6", "#6a1b9a", "#f07fc0"),
}
"""Colours by kind of estimator, neighbours differing in lightness; all of them are told apart on
white and in print."""
COLORS = tuple(family[i] for i in range(4) for family in FAMILIES.values())
"""Colours of the families by turns, for parameters and settings."""
BLACK = "#000000"
GREY = "#b0b0b0"
WHITE = "#ffffff"
SOFT = "#6f6f6f"
"""Colour of letters of what is grey."""
MARKERS = ("v", "P", "p", "<", "d", ">", "*", "^", "s", "o", "D")
DASHES: tuple[Any, ...] = ((1, 1.5), (5, 2, 1, 2), (8, 2, 1, 2, 1, 2), (3, 1, 1, 1))
"""Dash patterns of the pool as seaborn and matplotlib read them: lengths on and off."""
REFERENCE = "linear_lse"
"""Label of the reference estimator: black and crossed in every figure."""
BOUND_COLOR = "#444444"
BOUND_DASH = (0, (2, 2))
MOST_TOGETHER = 4
"""Curves in colour in one panel."""
MOST_FACES = 10
"""Estimators up to which each has a colour where no names stand at the curves."""
_LEGIBLE = 0.18
"""Largest relative luminance of letters on white."""
_BRIGHT = 0.22
"""Least relative luminance of letters on a dark page."""
_SEEN = 0.117
"""Least relative luminance of lines and marks on a dark page: a contrast of 3."""
_MIDDLE = 0.179
"""Relative luminance that has the same contrast with black and with white."""
DARK = "#0d1117"
"""What white becomes on a page that is dark."""
LIGHT = "#e6edf3"
"""What black becomes on a page that is dark."""

RAMP = (
    *("#f7f1e8", "#f6f1e8", "#f3efe8", "#f0eee8", "#ebece9", "#e6eae9", "#e1e8e9"),
    *("#dbe5ea", "#d5e3ea", "#c6dbe5", "#b8d3e1", "#a9cadc", "#99c2d7", "#87b6d0"),
    *("#74aac8", "#5f9bbe", "#498db5", "#387ea8", "#296d97", "#1a5b86", "#0b4a75"),
)
"""Colours of what is good, from none of it to all: the better, the darker, also in grey print."""
DARK_RAMP = (
    *("#211a14", "#211b15", "#211d19", "#211f1d", "#212222", "#212629", "#212a2f"),
    *("#212e36", "#21323d", "#233a48", "#254254", "#274a60", "#2a526c", "#2e5e7c"),
    *("#356c8d", "#3e7ca1", "#468bb5", "#569dc8", "#70b2da", "#8bc7ed", "#a5dcff"),
)
"""The same on a dark page: the better, the brighter."""
_ALL = 0.995
"""Goodness from which on a colour is that of all."""


def step(goodness: float) -> int:
    """Returns the place in `RAMP` of how good a number is, from 0 to 1."""
    last = len(RAMP) - 1
    return last if goodness >= _ALL else min(int(last * goodness), last - 1)


def ink(ground: str) -> str:
    """Returns black or white, whichever has more contrast with that colour: 4.5 or more on those of
    success."""
    red, green, blue = (int(ground[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return BLACK if _luminance((red, green, blue)) > _MIDDLE else WHITE


def which_figures(asked: Any) -> Which:
    """Returns the choice of this name; raises UserError if there is none."""
    if asked not in get_args(Which):
        raise UserError(f"figures={asked}: choose all, main or none")
    return cast(Which, asked)


def drawn_settings(number: int, which: Which) -> tuple[int, str]:
    """Returns how many of the settings have figures of their own, and a sentence on the others if
    there are any."""
    most = MOST_SETTINGS if which == "all" or number <= MOST_SETTINGS else FIRST_SETTINGS
    if number <= most:
        return number, ""
    more = f"; figures=all draws {MOST_SETTINGS} of the {number}" if which == "main" else ""
    return most, f"{number - most} further settings are in the tables{more}"


def file_formats(asked: Any) -> tuple[str, ...]:
    """Returns the formats asked for, in one word or several, with those that are always written;
    raises UserError if one is unknown."""
    words = asked
    if isinstance(asked, str) or not isinstance(asked, Sequence):
        words = str(asked).strip("[]").split(",")
    names = [str(word).strip() for word in words]
    if not names or not set(names) <= set(FORMATS):
        known = f"{', '.join(FORMATS[:-1])} and {FORMATS[-1]}"
        raise UserError(f"formats={','.join(names)}: choose among {known}")
    written = {PAGE, TABLES[0], *names}
    return tuple(kind for kind in FORMATS if kind in written)


@dataclass(frozen=True)
class Look:
    """How one estimator is drawn."""

    color: str
    marker: str
    dash: Any = ""
    width: float = 1.0
    """Of a line, in those of others."""

    @property
    def line(self) -> dict[str, Any]:
        """Arguments of a line with markers."""
        from matplotlib import rcParams

        dashes = (0, self.dash) if self.dash else "-"
        return {
            "color": self.color,
            "marker": self.marker,
            "linestyle": dashes,
            "linewidth": self.width * rcParams["lines.linewidth"],
            "markeredgecolor": "white",
        }


FACES = {
    REFERENCE: Look(BLACK, "X", (5, 2)),
    "fixed_point": Look("#123ba0", "o"),
    "newton": Look("#2299dc", "s"),
    "broyden": Look("#0f7f8f", "p", (5, 2)),
    "steepest_descent": Look("#5b76b8", "<", (5, 2)),
    "auto": Look("#7b2fd0", "D"),
    "ekf": Look("#6a0010", "^", (5, 2)),
    "ukf": Look("#f29a17", "v", (5, 2)),
}
"""The looks of those that the bench is about, which no other has and which are never grey. They
differ from each other in hue, marker and lightness, also for the colour-blind and in grey."""
POOL = (
    *(
        "gauss_newton",
        "relinearized",
        "ukf_rts",
        "ekf_rts",
        "progressive",
        "levenberg_marquardt",
        "iterated_ekf",
    ),
    *(
        "ckf",
        "map_lm",
        "enkf",
        "iplf",
        "ukf_wide",
        "anderson",
        "damped_newton",
        "minpack",
        "dogbox",
        "least_squares",
    ),
    *("geodesic_lm", "multiscale_lm", "multistart", "ghkf", "ieks", "ipls", "grid", "bootstrap"),
)
"""Our others, of which each has its own place among the markers and dashes; a name from elsewhere
has one by chance."""
_ALIKE = {"ipe_fixed_point": "fixed_point", "ipe_newton": "newton"}
"""Trackers under another name than the estimator of constants that does the same."""


def looks(
    labels: Sequence[str],
    kinds: Mapping[str, str] | None = None,
    own: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Look]:
    """Returns a look per label, the same whichever others are there: its `own` colour and marker,
    its face, or a place of the pool in the colours of its kind.

    Of two labels from elsewhere that chance gives one place, the later takes the next. What follows
    a name in brackets changes marker and dash alone. Two labels share a look where all of a family
    are taken.
    """
    found: dict[str, Look] = {}
    for label in labels:
        name = _ALIKE.get(label, label)
        color, marker = (own or {}).get(label, (None, None))
        face = FACES.get(name.partition(" (")[0])
        if face and color:
            face = replace(face, color=color)
        if face:
            color = face.color
        kind = (kinds or {}).get(label, "")
        family = (color,) if color else FAMILIES.get(kind, COLORS)
        place = _place(name)
        look = face if face and name in FACES else _from_pool(place, family)
        for _ in range(len(MARKERS) * len(DASHES) * len(family)):
            if look not in found.values():
                break
            place += 1
            look = _from_pool(place, family)
        found[label] = Look(look.color, marker or look.marker, look.dash)
    return found


def _place(name: str) -> int:
    """Returns the place of a name in the pool, or one by chance behind it."""
    if name in POOL:
        return POOL.index(name)
    return len(POOL) + crc32(name.encode()) % 1009


def _from_pool(at: int, family: Sequence[str]) -> Look:
    """Returns the look at a place: markers change first, then dashes, and colours with each
    place."""
    markers = len(MARKERS)
    places = markers * len(DASHES)
    color = family[(at + at // places) % len(family)]
    return Look(color, MARKERS[at % markers], DASHES[at // markers % len(DASHES)])


def strong(color: str) -> str:
    """Returns the colour, darkened until letters of it are read on white: a contrast of 4.5, as
    WCAG 2 asks for."""
    from matplotlib.colors import to_hex, to_rgb

    rgb: Any = to_rgb(color)
    while _luminance(rgb) > _LEGIBLE:
        rgb = [0.97 * c for c in rgb]
    return to_hex(rgb)


def _luminance(rgb: Sequence[float]) -> float:
    """Returns the relative luminance of sRGB by WCAG 2."""
    red, green, blue = map(_linear, rgb)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _linear(c: float) -> float:
    return c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4


def dark(color: str, *, letters: bool = False) -> str:
    """Returns what a colour on white becomes on a dark page: that of success is of the dark colours
    of success, greys change places, and the others are lighter, until lines have a contrast of 3
    and `letters` one of 4.5."""
    from matplotlib.colors import to_hex, to_rgb

    if color in RAMP:
        return DARK_RAMP[RAMP.index(color)]
    rgb: Any = to_rgb(color)
    if max(rgb) - min(rgb) > 0.05:
        rgb = [c + 0.25 * (1 - c) for c in rgb]
        least = _BRIGHT if letters else _SEEN
        while _luminance(rgb) < least:
            rgb = [c + 0.01 * (1 - c) for c in rgb]
        return to_hex(rgb)
    # White becomes the first end, black the second.
    share = 1 - rgb[0]
    ends = zip(to_rgb(DARK), to_rgb(LIGHT), strict=True)
    mixed: Any = [low + share * (high - low) for low, high in ends]
    return to_hex(mixed)


_HOUSE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "legend.frameon": False,
    "axes.edgecolor": "#888888",
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titley": 1.0,  # where they are anyway: to look for a place costs a fifth of the drawing
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "lines.markersize": 5.0,
    "lines.markeredgewidth": 0.5,
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "pdf.fonttype": 42,
    "figure.constrained_layout.wspace": 0.14,
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
    """Returns the width in inches of the column of print that figures are drawn for; 0 for those of
    the page."""
    return _print_width.get()


def _seaborn() -> Any:
    """Imports seaborn without SciPy's statistics, which take longer to load than it does: no figure
    of ours has the densities that it computes with them, and it has its own."""
    statistics = "scipy.stats"
    if statistics not in sys.modules and "seaborn" not in sys.modules:
        sys.modules[statistics] = None  # type: ignore[assignment]
        try:
            importlib.import_module("seaborn")
        finally:
            del sys.modules[statistics]
    return importlib.import_module("seaborn")


@contextmanager
def house_style(scale: float = 0.95, more: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Sets seaborn's white grid in its context of a paper, with letters of this scale."""
    import matplotlib as mpl

    sns = _seaborn()
    settings: dict[Any, Any] = {
        **sns.axes_style("whitegrid"),
        **sns.plotting_context("paper", font_scale=scale),
    }
    settings |= {**_HOUSE, **(more or {})}
    with mpl.rc_context(settings):
        yield


@contextmanager
def print_style(width: float) -> Iterator[None]:
    """Sets the same look in a column of print, which is not scaled any more: letters of 7 points,
    as IEEE's."""
    token = _print_width.set(width)
    try:
        with house_style(0.74, _PRINT):
            yield
    finally:
        _print_width.reset(token)
