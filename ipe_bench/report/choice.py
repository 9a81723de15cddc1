"""Which figures a report has, and as what files; without a library that draws any."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, cast, get_args

from ipe_bench.basics.errors import UserError

Which = Literal["all", "main", "none"]
"""All figures that the data allow, the few that answer the question, or none."""
PAGE = "png"
"""The format that is always written, as the page shows it."""
FORMATS = (PAGE, "pdf", "svg")


def which_figures(asked: Any) -> Which:
    """The choice that this word is; raises UserError if it is none."""
    if asked not in get_args(Which):
        raise UserError(f"figures={asked}: choose all, main or none")
    return cast(Which, asked)


def file_formats(asked: Any) -> tuple[str, ...]:
    """The formats asked for, in one word or several, with the page's; raises UserError if there is no such format."""
    words = asked if isinstance(asked, Sequence) and not isinstance(asked, str) else str(asked).strip("[]").split(",")
    names = [str(word).strip() for word in words]
    if not names or not set(names) <= set(FORMATS):
        raise UserError(f"formats={','.join(names)}: choose among {', '.join(FORMATS[:-1])} and {FORMATS[-1]}")
    return tuple(kind for kind in FORMATS if kind == PAGE or kind in names)
