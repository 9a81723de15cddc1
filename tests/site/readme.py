"""Writes what README shows of the stored experiment: its table, what it says, and its picture on
white and on a dark page. `make gallery` runs it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from ipe_bench.basics.files import make_folder, write_text
from ipe_bench.report.figures.headline import chosen, picture
from ipe_bench.report.figures.views import View, views
from ipe_bench.report.page.headline import headline
from ipe_bench.report.style import house_style
from ipe_bench.report.tables.table import Fact
from ipe_bench.report.words import brief, share_text
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.verdicts import OVERCONFIDENT

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
INDEX = ROOT / "ipe_bench/report/docs/pages/index.md"
PICTURES = (ROOT / ".assets" / "headline.png", ROOT / ".assets" / "headline_dark.png")
BEGINS = "<!-- make gallery -->\n"
ENDS = "<!-- end -->\n"
_ROWS = 6
"""Estimators of the table."""
_COLUMNS = 2
"""Error scales of the table: the largest ones."""
_FACTS = ("Small errors", "Price")
_COLORS = 128


def block(analysis: Analysis) -> str:
    """Returns the table and what it says, as they stand in README."""
    return "\n".join([*_table(view_of(analysis)), "", *_said(analysis)]) + "\n"


def view_of(analysis: Analysis) -> View:
    (view,), _ = views(analysis)
    return view


def _table(view: View) -> Iterator[str]:
    """Returns the estimators of the picture, the best first: success at the largest error scales,
    with a sign where the covariance is too small, and what a trial costs at the last."""
    scales = view.scales[-_COLUMNS:]
    heads = [f"{scale:g}" for scale in scales]
    yield f"| success, %, at error scale | {' | '.join(heads)} | simulations at {heads[-1]} |"
    yield "|:--|" + "--:|" * (len(scales) + 1)
    rows = view.totals.set_index(["estimator", "error_scale"])
    for name in chosen(view.totals, view.families, _ROWS):
        cells = []
        for scale in scales:
            row = rows.loc[name, scale]
            sign = " ▲" if row["verdict"] == OVERCONFIDENT else ""
            cells.append(f"{share_text(row['success'])}{sign}")
        cost = brief(rows.loc[name, scales[-1]]["simulations_median"])
        yield f"| `{name}` | {' | '.join(cells)} | {cost} |"


def _said(analysis: Analysis) -> Iterator[str]:
    """Returns the facts of the page that the picture does not show: who is the cheapest."""
    yield "▲: the reported error bars are too small."
    yield ""
    for part in headline(analysis):
        if isinstance(part, Fact) and part.label in _FACTS:
            yield f"- {part.text}"


def write_readme(analysis: Analysis) -> None:
    """Writes the block between its marks, the finding on the site's front page, and both
    pictures."""
    text = README.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGINS)
    _, _, after = rest.partition(ENDS)
    write_text(README, f"{before}{BEGINS}{block(analysis)}{ENDS}{after}")
    finding, *_ = headline(analysis)
    index = INDEX.read_text(encoding="utf-8")
    write_text(INDEX, re.sub(r"(?m)^\*\*.*\*\*$", f"**{finding}**", index, count=1))
    with house_style():
        for dark, path in enumerate(PICTURES):
            save(view_of(analysis), path, dark=bool(dark))


def save(view: View, path: Path, *, dark: bool = False) -> None:
    """Saves the picture in few colours."""
    picture(view, dark=dark).savefig(path, dpi="figure")
    store_picture(path, path)


def store_picture(drawn: Path, path: Path) -> None:
    """Writes a picture in few colours, which take a third of the room."""
    from PIL import Image

    with Image.open(drawn) as image:
        few = image.convert("RGB").quantize(_COLORS, dither=Image.Dither.NONE)
    make_folder(path.parent)
    few.save(path, optimize=True)
