"""Defines a drawn figure with its caption."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.files import write_atomically
from ipe_bench.report.figures.svg import page_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

MOST_LETTERS = 300_000
"""Length of a figure on a page from which on its curves and points are a bitmap."""
_WIDE = 9.0
"""Inches of a figure above which facts have no room beside it."""
_METADATA: dict[str, Any] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
"""The same figure is the same file whenever it is drawn."""


@dataclass(frozen=True)
class Drawn:
    """Holds a figure in its folder."""

    name: str
    title: str
    caption: str
    files: tuple[Path, ...]
    html: str
    """The figure as a page shows it."""
    wide: bool
    """Whether it takes the width of the page."""
    kind: str = ""
    """Its name without that of the setting, where a page has one for each."""


@dataclass(frozen=True)
class Drawing:
    """A figure with its file name, its title and a caption that says what is seen."""

    name: str
    title: str
    caption: str
    figure: Canvas
    kind: str = ""
    """Its name without that of the setting, where a page has one for each."""

    def drawn(self, folder: Path, formats: Sequence[str]) -> Drawn:
        """Writes the figure, and returns what a page shows of it."""
        files = self.save(folder, formats)
        # Laid out once: again for the page takes a third of the time.
        self.figure.set_layout_engine("none")
        wide = self.figure.get_figwidth() > _WIDE
        return Drawn(self.name, self.title, self.caption, files, self.html(), wide, self.kind)

    def shown(self) -> Canvas:
        """Shows the figure itself in a notebook."""
        self.figure._repr_png_ = lambda: self._content("png")  # type: ignore[attr-defined]
        return self.figure

    def save(self, folder: Path, formats: Sequence[str] = ("png", "pdf")) -> tuple[Path, ...]:
        """Writes the figure in these formats, named for it; no file is ever seen half written."""
        paths = {kind: folder / f"{self.name}.{kind}" for kind in formats}
        for kind, path in paths.items():
            write_atomically(path, methodcaller("write_bytes", self._content(kind)))
        return tuple(paths.values())

    def html(self) -> str:
        """Returns the figure as a page shows it."""
        from matplotlib import rc_context

        # Names within the figure are its own on a page of several.
        with rc_context({"svg.fonttype": "none", "svg.hashsalt": self.name}):
            page = page_figure(self.figure, self._content("svg").decode())
            if len(page) > MOST_LETTERS:
                for ax in self.figure.axes:
                    for artist in (*ax.lines, *ax.collections):
                        artist.set_rasterized(True)
                page = page_figure(self.figure, self._content("svg").decode())
        return page

    def _content(self, kind: str) -> bytes:
        from matplotlib.backend_bases import get_registered_canvas_class

        canvas = get_registered_canvas_class(kind)(self.figure)
        content = BytesIO()
        dpi = self.figure.dpi
        with warnings.catch_warnings():
            # Labels of great length leave a panel no room: it is drawn as it is.
            warnings.filterwarnings("ignore", "constrained_layout not applied")
            # `savefig` draws twice, for the layout and for the file, which takes a third longer.
            getattr(canvas, f"print_{kind}")(content, metadata=_METADATA.get(kind))
        self.figure.dpi = dpi  # which vectors set to 72
        get_registered_canvas_class("png")(self.figure)  # by which a page's panels are measured
        return content.getvalue()
