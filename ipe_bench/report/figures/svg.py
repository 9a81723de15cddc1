"""Turns a drawn figure into what a page shows: an SVG per panel, which stand below each other on a
phone, and the keys of the legend. Styles are classes, whose colours a dark page changes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING
from zlib import crc32

from ipe_bench.report.style import dark

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMED = "name:"
"""Begins the id of an artist that is an estimator's; its name ends at `#`. On a page it is
`data-name`."""
Ends = tuple[float, float]
"""Ends of a column from the left, or of a row from above, in points."""
LEAST_LETTERS = 10.0
"""Pixels of the smallest letters of a panel on a phone, where wider ones are scrolled."""
_SIZE = re.compile(r"font(?:-size)?: ([\d.]+)px")
_MARGIN = 3.0
"""Points around a panel."""
_WIDER = 0.04
"""Part by which texts may be wider in another font than the one measured."""
_FIGURE = re.compile(r'^ <g id="figure_1">\n(.*?)^ </g>\n(.*)^</svg>', re.MULTILINE | re.DOTALL)
_GROUP = re.compile(r'^  <g id="(axes|legend)_\d+">\n(.*?)^  </g>\n', re.MULTILINE | re.DOTALL)
_KEY = re.compile(
    r'(.*?)<g id="text_\d+">\s*<text style="font-size: ([\d.]+)px.*? x="([\d.]+)" y="([\d.]+)"'
    r".*?>(.*?)</text>\s*</g>",
    re.DOTALL,
)


def page_figure(figure: Figure, svg: str) -> str:
    """Returns the HTML of a figure that matplotlib wrote as this SVG with texts as texts; one whose
    panels are in no plain grid is one SVG."""
    content, definitions = _FIGURE.findall(svg)[0]
    groups = _GROUP.findall(content)
    panels = [inside for kind, inside in groups if kind == "axes"]
    legends = [inside for kind, inside in groups if kind == "legend"]
    cells = _cells(figure)
    if cells:
        shown = ["".join(panels[i] for i in inside) for inside in cells.values()]
        keys = [_key(*key) for inside in legends for key in _KEY.findall(inside)]
    else:
        shown = [content]
        keys = []
    shown[0] += definitions
    columns, rows = _edges(figure, cells)
    views = []
    for (down, at), inside in zip(cells or [(0, 0)], shown, strict=True):
        views.append(_view(columns[at], rows[down], inside))
    widths = [right - left for left, right in columns.values()]
    grid = " ".join(f"minmax(0,{width:.0f}fr)" for width in widths)
    size = f"grid-template-columns:{grid};max-width:{sum(widths) / 60:.1f}in"
    legend = f'<div class="keys">{"".join(keys)}</div>'
    kind = "panels many" if len(widths) > 2 else "panels"
    return _classed(f'{legend}<div class="{kind}" style="{size}">{"".join(views)}</div>')


def _view(across: Ends, down: Ends, inside: str) -> str:
    """Returns an SVG that shows a part of the figure."""
    left, right = across
    top, bottom = down
    box = f"{left:.1f} {top:.1f} {right - left:.1f} {bottom - top:.1f}"
    least = least_width(right - left, inside)
    return f'<svg viewBox="{box}" style="--least:{least:.0f}px">{inside}</svg>'


def least_width(width: float, svg: str) -> float:
    """Returns the width in pixels from which on letters of a panel, `width` points wide, are large
    enough."""
    sizes = [float(size) for size in _SIZE.findall(svg)]
    return width * LEAST_LETTERS / min(sizes) if sizes else 0.0


def _cells(figure: Figure) -> dict[tuple[int, int], list[int]]:
    """Returns which axes stand at each row and column; empty if they are in no plain grid, or are
    not all there is."""
    specs = [ax.get_subplotspec() for ax in figure.axes]
    single = [spec for spec in specs if spec and spec.num1 == spec.num2]
    if figure.texts or len(single) < len(specs):
        return {}
    if len({id(spec.get_gridspec()) for spec in single}) != 1:
        return {}
    cells: dict[tuple[int, int], list[int]] = {}
    for i, spec in enumerate(single):
        if figure.axes[i].axison:
            place = (spec.rowspan.start, spec.colspan.start)
            cells.setdefault(place, []).append(i)
    return cells


def _edges(
    figure: Figure, cells: dict[tuple[int, int], list[int]]
) -> tuple[dict[int, Ends], dict[int, Ends]]:
    """Returns the ends of each column and of each row."""
    width, height = 72 * figure.get_size_inches()
    points = 72 / figure.dpi
    columns: dict[int, Ends] = {}
    rows: dict[int, Ends] = {}
    for (row, column), inside in cells.items():
        for ax in (figure.axes[i] for i in inside):
            box = ax.get_tightbbox()
            if box is None:
                continue
            # Letters of another font than the one measured may need more room beside the axes.
            left = box.x0 - _WIDER * (ax.bbox.x0 - box.x0)
            right = box.x1 + _WIDER * (box.x1 - ax.bbox.x1)
            _widen(columns, column, points * left, points * right)
            # Matplotlib measures heights from below.
            _widen(rows, row, height - points * box.y1, height - points * box.y0)
    return columns or {0: (0.0, width)}, rows or {0: (0.0, height)}


def _widen(ends: dict[int, Ends], at: int, low: float, high: float) -> None:
    """Widens a column or row until it holds what reaches from `low` to `high`."""
    least, most = ends.get(at, (low, high))
    ends[at] = (min(least, low - _MARGIN), max(most, high + _MARGIN))


def _key(handle: str, size: str, x: str, y: str, label: str) -> str:
    """Returns an entry of the legend: its line and marker, which end left of the text, as a
    drawing, and its text."""
    em = float(size)
    left = float(x) - 2.9 * em
    top = float(y) - em
    box = f"{left:.1f} {top:.1f} {2.4 * em:.1f} {1.3 * em:.1f}"
    return f'<span><svg viewBox="{box}">{handle}</svg>{label}</span>'


def _at_night(style: str) -> str:
    """Returns the style with the colours of a dark page."""
    letters = "font" in style
    return re.sub("#[0-9a-f]{6}", lambda color: dark(color[0], letters=letters), style)


def _classed(html: str) -> str:
    """Returns the same with a class for each style, and exact to 1/100 point."""
    styles: dict[str, str] = {}

    def named(found: re.Match[str]) -> str:
        name = f"s{crc32(found[1].encode()):x}"
        styles[name] = re.sub(r"font-family: [^;]*; ", "", found[1])
        return f' class="{name}"'

    def rounded(found: re.Match[str]) -> str:
        return re.sub(r"(\.\d\d)\d+|\s*\n", r"\1", found[0])

    def rewritten(tag: re.Match[str]) -> str:
        short = re.sub(rf'^<g id="{NAMED}([^"#]*)#[^"]*"', r'<g data-name="\1"', tag[0])
        short = re.sub(r'^<g id="[^"]*"', "<g", short)
        short = re.sub(r' style="((?:fill|stroke|font|opacity|clip)[^"]*)"', named, short)
        short = re.sub(r' transform="rotate\(-0 [^"]*"', "", short)
        return re.sub(r' (?:d|x|y)="[^"]*"', rounded, short)

    # In tags alone: a name between them may read as an attribute, and matplotlib escapes no quotes
    # there.
    html = re.sub(r"<\w[^<>]*>", rewritten, html)
    html = re.sub(r">\s*\n\s*<", "><", html)
    rules = [f".{name}{{{style}}}" for name, style in styles.items()]
    dimmed = [f".{name}{{{_at_night(style)}}}" for name, style in styles.items()]
    light = "".join(rules)
    night = "".join(dimmed)
    return f"<style>{light}@media screen and (prefers-color-scheme:dark){{{night}}}</style>{html}"
