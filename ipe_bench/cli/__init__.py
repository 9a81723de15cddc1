"""The command line. Hydra is known here and nowhere else."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING

from ipe_bench.basics.errors import UserError, unknown

if TYPE_CHECKING:
    from rich.console import Console

    from ipe_bench.report.table import Part

_WIDTH_WITHOUT_TERMINAL = 120


def console() -> Console:
    """Where tables are printed: as wide as the terminal, or wide enough for a table in a file."""
    from rich.console import Console

    shown = Console(highlight=False)
    return shown if shown.is_terminal else Console(highlight=False, width=_WIDTH_WITHOUT_TERMINAL)


def show(parts: Iterable[Part]) -> None:
    """Prints tables and sentences."""
    from ipe_bench.report.table import terminal

    out = console()
    out.print(terminal(parts, out.width))


def given_keys(command: str, words: Sequence[str], keys: Collection[str]) -> dict[str, str]:
    """The words KEY=VALUE after a command that Hydra does not read.

    Raises:
        UserError: a key is none of `keys`, or stands there twice.
    """
    found: dict[str, str] = {}
    for word in words:
        key, _, value = word.partition("=")
        if key not in keys:
            raise UserError(f"{command}: {word}: {unknown(key, keys, 'key')}")
        if key in found:
            raise UserError(f"{command}: {word}: {key} stands there twice; give it once")
        found[key] = value
    return found
