"""A drawn figure with its words, and how it comes to disk."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

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
        paths = []
        # The layout is worked out once; every further save would repeat it.
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")
        for suffix, nothing in ((".png", "Software"), (".pdf", "CreationDate")):
            path = folder / f"{self.name}{suffix}"
            temporary = folder / f".{self.name}{suffix}.{os.getpid()}.tmp"
            self.figure.savefig(temporary, format=suffix[1:], dpi=150, metadata={nothing: None})
            os.replace(temporary, path)
            paths.append(path)
        return paths[0], paths[1]
