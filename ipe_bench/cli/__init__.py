"""The command line. Hydra is known here and nowhere else."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

_WIDTH_WITHOUT_TERMINAL = 120


def console() -> Console:
    """Where tables are printed: as wide as the terminal, or wide enough for a table in a file."""
    from rich.console import Console

    shown = Console(highlight=False)
    return shown if shown.is_terminal else Console(highlight=False, width=_WIDTH_WITHOUT_TERMINAL)
