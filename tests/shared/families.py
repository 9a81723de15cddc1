"""Marks the dear members of a family of tests, one of which stands for all while the others
wait."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def slow_if(dear: Callable[..., bool], members: Iterable[Any]) -> list[Any]:
    """Returns the parameters of a test, those slow that `dear` chooses."""
    found = []
    for member in members:
        values = member if isinstance(member, tuple) else (member,)
        marks = (pytest.mark.slow,) if dear(*values) else ()
        found.append(pytest.param(*values, marks=marks))
    return found
