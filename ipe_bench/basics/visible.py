"""Keeps a terminal from obeying what names say: every text of a command goes through here on its
way out."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters besides tabs and the ends of lines, and those that reverse the direction of a
text."""


def visible(text: str) -> str:
    r"""Writes control characters as Python does, such as \x1b: they colour, clear and rename a
    terminal."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class VisibleStream:
    """Writes to a stream what is printed, without control characters.

    Rich writes past it, with those that it makes itself; see `Screen`, which cleans the texts.
    """

    def __init__(self, stream: Any) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        return self.rich_proxied_file.write(visible(text))

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)
