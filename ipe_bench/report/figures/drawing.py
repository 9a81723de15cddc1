"""A drawn figure with its words, and how it comes to disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ipe_bench.basics.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Drawing:
    """A figure with its file name, its title and a caption that says what is seen."""

    name: str
    title: str
    caption: str
    figure: Figure

    def save(self, folder: Path) -> tuple[Path, Path]:
        """Writes PNG and PDF; no file is ever seen half written."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.backends.backend_pdf import FigureCanvasPdf

        # Layout once and one drawing per file: `savefig` would draw everything five times.
        engine = self.figure.get_layout_engine()
        if engine is not None:
            engine.execute(self.figure)
            self.figure.set_layout_engine("none")
        png, pdf = (folder / f"{self.name}{suffix}" for suffix in (".png", ".pdf"))
        write_atomically(png, lambda path: FigureCanvasAgg(self.figure).print_png(path, metadata={"Software": None}))
        write_atomically(
            pdf, lambda path: FigureCanvasPdf(self.figure).print_pdf(path, metadata={"CreationDate": None})
        )
        return png, pdf
