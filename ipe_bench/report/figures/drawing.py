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

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_METADATA: dict[str, Any] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
"""The same figure is the same file whenever it is drawn."""


@dataclass(frozen=True)
class Drawing:
    """A figure with its file name, its title and a caption that says what is seen."""

    name: str
    title: str
    caption: str
    figure: Canvas

    def shown(self) -> Canvas:
        """Shows the figure itself in a notebook."""
        self.figure._repr_png_ = lambda: self._content("png")  # type: ignore[attr-defined]
        return self.figure

    def save(self, folder: Path, formats: Sequence[str] = ("png", "pdf")) -> tuple[Path, ...]:
        """Writes the figure in these formats, named for it; no file is ever seen half written."""
        paths = []
        for kind in formats:
            paths.append(folder / f"{self.name}.{kind}")
            write_atomically(paths[-1], methodcaller("write_bytes", self._content(kind)))
        return tuple(paths)

    def _content(self, kind: str) -> bytes:
        content = BytesIO()
        with warnings.catch_warnings():
            # Labels of great length leave a panel no room: it is drawn as it is.
            warnings.filterwarnings("ignore", "constrained_layout not applied")
            self.figure.savefig(content, format=kind, metadata=_METADATA.get(kind))
        return content.getvalue()
