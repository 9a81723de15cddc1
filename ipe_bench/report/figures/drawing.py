"""A kind of figure, a drawn figure with its words, and how it comes to disk."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from ipe_bench.report.figures.views import View

FORMATS = ("png", "pdf")
"""Those in which a command writes its figures that writes few; see `choice` for the report's."""


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
    """Belongs to the few that answer the question; see `Gallery`."""
    weight: float = 1.0
    """About how long it takes to draw beside others: what takes longest is begun first."""


@dataclass(frozen=True)
class Drawing:
    """A figure with its file name, its title and a caption that says what is seen."""

    name: str
    title: str
    caption: str
    figure: Canvas

    def save(self, folder: Path, formats: Sequence[str] = FORMATS) -> tuple[Path, ...]:
        """Writes the figure in these formats, named for it; no file is ever seen half written."""
        rendered = self.rendered(formats)
        paths = tuple(folder / f"{self.name}.{kind}" for kind in formats)
        for path, kind in zip(paths, formats, strict=True):
            write_bytes(path, rendered[kind])
        return paths

    def rendered(self, formats: Sequence[str]) -> dict[str, bytes]:
        """The content of a file of each of these formats."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        # Layout once, with a renderer that is made once, and one drawing per file: `savefig` would draw all five times.
        FigureCanvasAgg(self.figure)
        engine = self.figure.get_layout_engine()
        if engine is not None:
            with warnings.catch_warnings():
                # Labels of great length leave a panel no room: it is drawn as it is.
                warnings.filterwarnings("ignore", "constrained_layout not applied")
                engine.execute(self.figure)
            self.figure.set_layout_engine("none")
        return {kind: {"png": self._png, "pdf": self._pdf, "svg": self._svg}[kind]() for kind in formats}

    def _png(self) -> bytes:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        return png(np.asarray(canvas.buffer_rgba()), self.figure.dpi)

    def _pdf(self) -> bytes:
        from matplotlib.backends.backend_pdf import FigureCanvasPdf

        return self._printed(FigureCanvasPdf(self.figure).print_pdf, metadata={"CreationDate": None})

    def _svg(self) -> bytes:
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        return self._printed(FigureCanvasSVG(self.figure).print_svg, metadata={"Date": None})

    def _printed(self, write: Callable[..., Any], **options: Any) -> bytes:
        file, dpi = BytesIO(), self.figure.dpi
        write(file, **options)
        # Both leave the figure in points.
        self.figure.set_dpi(dpi)
        return file.getvalue()


def png(pixels: np.ndarray, dpi: float) -> bytes:
    """The file of an opaque picture (height, width, 4), as ISO/IEC 15948 has it.

    Lines on an even ground take no filter before they are deflated: matplotlib's files are larger and take twice as
    long.
    """
    height, width = pixels.shape[:2]
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    rows[:, 1:] = pixels[:, :, :3].reshape(height, -1)
    metre = round(dpi / 0.0254)
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"pHYs", struct.pack(">IIB", metre, metre, 1)),
        (b"IDAT", zlib.compress(rows.data, 6)),
        (b"IEND", b""),
    )
    parts = [struct.pack(">I", len(d)) + name + d + struct.pack(">I", zlib.crc32(name + d)) for name, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
