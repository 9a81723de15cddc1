"""A kind of figure, a drawn figure with its words, and how it comes to disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ipe_bench.basics.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from ipe_bench.report.figures.views import View

FORMATS = ("png", "pdf")


@dataclass(frozen=True)
class Figure:
    """A kind of figure: a module of this folder holds one under the name FIGURE."""

    draw: Callable[[View], Iterator[Drawing]]
    """Draws what a view allows; nothing where it would be empty."""
    frames: tuple[str, ...]
    """The frames of the analysis that it reads; its view has no others."""
    together: bool = False
    """Drawn once of all settings, not once of each."""
    main: bool = False
    """Belongs to the few that answer the question; see `draw_all`."""


@dataclass(frozen=True)
class Drawing:
    """A figure with its file name, its title and a caption that says what is seen."""

    name: str
    title: str
    caption: str
    figure: Canvas

    def save(self, folder: Path, formats: Sequence[str] = FORMATS) -> tuple[Path, ...]:
        """Writes the figure in these formats, named for it; no file is ever seen half written."""
        # Layout once and one drawing per file: `savefig` would draw everything five times.
        engine = self.figure.get_layout_engine()
        if engine is not None:
            engine.execute(self.figure)
            self.figure.set_layout_engine("none")
        paths = tuple(folder / f"{self.name}.{kind}" for kind in formats)
        for path, kind in zip(paths, formats, strict=True):
            write_atomically(path, {"png": self._png, "pdf": self._pdf}[kind])
        return paths

    def _png(self, path: Path) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        FigureCanvasAgg(self.figure).print_png(path, metadata={"Software": None})

    def _pdf(self, path: Path) -> None:
        from matplotlib.backends.backend_pdf import FigureCanvasPdf

        FigureCanvasPdf(self.figure).print_pdf(path, metadata={"CreationDate": None})
