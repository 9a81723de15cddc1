"""Implements the command line; only this room knows Hydra."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.errors import UserError, refuse_unknown

if TYPE_CHECKING:
    from rich.console import Console

    from ipe_bench.report.tables.table import Part

_WIDTH_WITHOUT_TERMINAL = 120


def console() -> Console:
    """Makes the console for tables: as wide as the terminal, or wide enough for a table in a
    file."""
    from ipe_bench.report.screen import Screen

    out = Screen()
    out.on_broken_pipe = discard_output
    if not out.is_terminal:
        out.width = _WIDTH_WITHOUT_TERMINAL
    return out


def discard_output() -> None:
    """Sends the rest of the output nowhere: its reader has closed the pipe, which is no mistake."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def say(*lines: str) -> None:
    """Prints lines as they are, which a terminal may fold."""
    for line in lines:
        console().print(line, soft_wrap=True)


def print_problems(lines: Iterable[str]) -> None:
    """Says on stderr what is wrong, a line each."""
    sys.stdout.flush()
    for line in lines:
        print(f"ipe-bench: {line}", file=sys.stderr)


def show(parts: Iterable[Part]) -> None:
    """Prints tables and sentences."""
    from ipe_bench.report.tables.table import terminal

    out = console()
    out.print(terminal(parts, out.width))


def say_files(files: Sequence[Path]) -> None:
    """Says which files a command has written into its folder."""
    say(f"\nIn {files[0].parent}:")
    console().print(", ".join(path.name for path in files))


def places_and_keys(
    command: str, words: Sequence[str], kinds: Mapping[str, Any]
) -> tuple[list[str], dict[str, Any]]:
    """Splits off the files and folders after a command that Hydra does not read, and keys' values
    by their types."""
    from ipe_bench.basics.options import Count, checked
    from ipe_bench.questions.question import NAMES

    refuse_blanks(words)
    # A folder may be named after a choice, such as error_scale=10, but not after a key's value.
    places = [
        word
        for word in words
        if "=" not in word or (word.partition("=")[0] not in kinds and Path(word).is_dir())
    ]
    found: dict[str, Any] = {}
    for word in (word for word in words if word not in places):
        key, _, text = word.partition("=")
        refuse_unknown(f"{command}: {word}", key, kinds, "key")
        if key in found:
            raise UserError(f"{command}: {word}: {key} is given twice")
        if not text:
            raise UserError(f"{command}: {word}: give it a value")
        value: Any = text
        if kinds[key] is NAMES:
            value = listed(text)
        elif kinds[key] is bool:
            value = {"true": True, "false": False}.get(text, text)
        elif kinds[key] in (float, Count):
            with contextlib.suppress(ValueError):
                value = float(text) if kinds[key] is float else int(text)
        found[key] = checked(value, kinds[key], key)
    return places, found


def listed(text: str) -> list[str]:
    """Returns the names in A,B or [A,B]."""
    return [name.strip() for name in text.strip("[]").split(",") if name.strip()]


def refuse_blanks(words: Sequence[str]) -> None:
    """Refuses KEY = VALUE, of which a shell makes several words."""
    for i, (first, second) in enumerate(itertools.pairwise(words)):
        if (second.startswith("=") and "=" not in first) or (
            first.endswith("=") and "=" not in second
        ):
            parts = words[i : i + 3] if second == "=" else (first, second)
            raise UserError(
                f"{' '.join(parts)}: has a blank next to the equals sign; write {''.join(parts)}"
            )
