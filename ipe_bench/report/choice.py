"""Which figures a report has; without a library that draws any."""

from __future__ import annotations

from typing import Any, Literal, cast, get_args

from ipe_bench.basics.errors import UserError

Which = Literal["all", "main", "none"]
"""All that the data allow, the few that answer the question, or none."""


def which_figures(asked: Any) -> Which:
    """The choice that this word is.

    Raises:
        UserError: it is none.
    """
    if asked not in get_args(Which):
        raise UserError(f"figures={asked}: choose all, main or none")
    return cast(Which, asked)
