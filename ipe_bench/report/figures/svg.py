"""Turns a drawn figure into what a page shows: an SVG per panel, which stand below each other on a phone, and the keys
of the legend. Styles are classes, whose colours a dark page changes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING
from zlib import crc32

from ipe_bench.report.style import dark

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMED = "name:"
"""Begins the id of an artist that is an estimator's; its name ends at `#`. On a page it is `data-name`."""
_MARGIN, _WIDER = 3.0, 0.04
"""Points around a panel, and the part by which texts may be wider in another font."""
_FIGURE = re.compile(r'^ <g id="figure_1">\n(.*?)^ </g>\n(.*)^</svg>', re.MULTILINE | re.DOTALL)
_GROUP = re.compile(r'^  <g id="(axes|legend)_\d+">\n(.*?)^  </g>\n', re.MULTILINE | re.DOTALL)
_KEY = re.compile(
    r'(.*?)<g id="text_\d+">\s*<text style="font-size: ([\d.]+)px.*? x="([\d.]+)" y="([\d.]+)".*?>(.*?)</text>\s*</g>',
    re.DOTALL,
)


def page_figure(figure: Figure, svg: str) -> str:
    """Returns the HTML of a figure that matplotlib wrote as this SVG with texts as texts; one whose panels are in no
    plain grid is one SVG."""
    content, definitions = _FIGURE.findall(svg)[0]
    groups, cells = _GROUP.findall(content), _cells(figure)
    panels = [inside for kind, inside in groups if kind == "axes"]
    shown = ["".join(panels[i] for i in inside) for inside in cells.values()] or [content]
    keys = [
        _key(*key)
        for kind, inside in groups
        if kind == "legend" and cells
        for key in _KEY.findall(inside)
    ]
    columns, rows = _edges(figure, cells)
    boxes = [(*columns[at], *rows[down]) for down, at in cells or [(0, 0)]]
    shown[0] += definitions
    views = (
        f'<svg viewBox="{left:.1f} {top:.1f} {right - left:.1f} {bottom - top:.1f}">{inside}</svg>'
        for (left, right, top, bottom), inside in zip(boxes, shown, strict=True)
    )
    widths = [right - left for left, right in columns.values()]
    grid = " ".join(f"minmax(0,{width:.0f}fr)" for width in widths)
    size = f"grid-template-columns:{grid};max-width:{sum(widths) / 60:.1f}in"
    return _classed(
        f'<div class="keys">{"".join(keys)}</div><div class="panels" style="{size}">{"".join(views)}</div>'
    )


def _cells(figure: Figure) -> dict[tuple[int, int], list[int]]:
    """Returns which axes stand at each row and column; empty if they are in no plain grid, or are not all there is."""
    cells: dict[tuple[int, int], list[int]] = {}
    specs = [
        spec for ax in figure.axes if (spec := ax.get_subplotspec()) and spec.num1 == spec.num2
    ]
    if (
        figure.texts
        or len(specs) < len(figure.axes)
        or len({id(spec.get_gridspec()) for spec in specs}) != 1
    ):
        return {}
    for i, (ax, spec) in enumerate(zip(figure.axes, specs, strict=True)):
        if ax.axison:
            cells.setdefault((spec.rowspan.start, spec.colspan.start), []).append(i)
    return cells


def _edges(
    figure: Figure, cells: dict[tuple[int, int], list[int]]
) -> list[dict[int, tuple[float, float]]]:
    """Returns the ends of each column from the left and of each row from above, in points."""
    width, height = 72 * figure.get_size_inches()
    columns, rows = dict[int, tuple[float, float]](), dict[int, tuple[float, float]]()
    for (row, column), inside in cells.items():
        for ax in (figure.axes[i] for i in inside):
            box, own = ax.get_tightbbox(), ax.bbox
            if box is None:
                continue
            # Letters of another font than the one measured may need more room beside the axes.
            left, right = box.x0 - _WIDER * (own.x0 - box.x0), box.x1 + _WIDER * (box.x1 - own.x1)
            x0, y0, x1, y1 = (72 / figure.dpi * v for v in (left, box.y0, right, box.y1))
            for ends, at, low, high in (
                (columns, column, x0, x1),
                (rows, row, height - y1, height - y0),
            ):
                least, most = ends.get(at, (low, high))
                ends[at] = min(least, low - _MARGIN), max(most, high + _MARGIN)
    return [columns or {0: (0.0, width)}, rows or {0: (0.0, height)}]


def _key(handle: str, size: str, x: str, y: str, label: str) -> str:
    """Returns an entry of the legend: its line and marker, which end left of the text, as a drawing, and its text."""
    em = float(size)
    box = f"{float(x) - 2.9 * em:.1f} {float(y) - em:.1f} {2.4 * em:.1f} {1.3 * em:.1f}"
    return f'<span><svg viewBox="{box}">{handle}</svg>{label}</span>'


def _classed(html: str) -> str:
    """Returns the same with a class for each style, and exact to 1/100 point."""
    styles: dict[str, str] = {}

    def named(found: re.Match[str]) -> str:
        name = f"s{crc32(found[1].encode()):x}"
        styles[name] = re.sub(r"font-family: [^;]*; ", "", found[1])
        return f' class="{name}"'

    def rewritten(tag: re.Match[str]) -> str:
        short = re.sub(rf'^<g id="{NAMED}([^"#]*)#[^"]*"', r'<g data-name="\1"', tag[0])
        short = re.sub(r'^<g id="[^"]*"', "<g", short)
        short = re.sub(r' style="((?:fill|stroke|font|opacity|clip)[^"]*)"', named, short)
        short = re.sub(r' transform="rotate\(-0 [^"]*"', "", short)
        return re.sub(
            r' (?:d|x|y)="[^"]*"',
            lambda found: re.sub(r"(\.\d\d)\d+|\s*\n", r"\1", found[0]),
            short,
        )

    # In tags alone: a name between them may read as an attribute, and matplotlib escapes no quotes there.
    html = re.sub(r"<\w[^<>]*>", rewritten, html)
    light = "".join(f".{name}{{{style}}}" for name, style in styles.items())
    night = re.sub("#[0-9a-f]{6}", lambda color: dark(color[0]), light)
    html = re.sub(r">\s*\n\s*<", "><", html)
    return f"<style>{light}@media screen and (prefers-color-scheme:dark){{{night}}}</style>{html}"
