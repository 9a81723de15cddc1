"""The command line. Hydra is known here and nowhere else."""

from __future__ import annotations

import os
import sys
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

    class Shown(Console):
        def on_broken_pipe(self) -> None:
            discard_output()

    shown = Shown(highlight=False)
    return shown if shown.is_terminal else Shown(highlight=False, width=_WIDTH_WITHOUT_TERMINAL)


def discard_output() -> None:
    """Sends the rest of the output nowhere: its reader has closed the pipe, which is no mistake."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def say(*lines: str) -> None:
    """Prints lines as they are, which a terminal may fold."""
    for line in lines:
        console().print(line, markup=False, soft_wrap=True)


def print_problems(lines: Iterable[str]) -> None:
    """Says on stderr what is wrong, a line each."""
    sys.stdout.flush()
    for line in lines:
        print(f"ipe-bench: {line}", file=sys.stderr)


def show(parts: Iterable[Part]) -> None:
    """Prints tables and sentences."""
    from ipe_bench.report.table import terminal

    out = console()
    out.print(terminal(parts, out.width))


def given_keys(command: str, words: Sequence[str], keys: Collection[str]) -> dict[str, str]:
    """The words KEY=VALUE after a command that Hydra does not read.

    Raises:
        UserError: a key is none of `keys`, stands there twice, or has no value.
    """
    found: dict[str, str] = {}
    for word in words:
        key, _, value = word.partition("=")
        if key not in keys:
            raise UserError(f"{command}: {word}: {unknown(key, keys, 'key')}")
        if key in found:
            raise UserError(f"{command}: {word}: {key} stands there twice; give it once")
        if not value:
            raise UserError(f"{command}: {word}: give it a value")
        found[key] = value
    return found
