"""Lets Hydra 1.3 add its flags on Python 3.14, whose argparse wants every help to be a text."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def flags_of_hydra() -> Iterator[None]:
    """Within it, the help of a flag need not be a text yet, as that of Hydra's --shell-completion is not.

    Python 3.14 formats each help as its flag is added, to find mistakes early, and does not expect an object that is
    made a text only where it is shown.
    """
    check: Any = getattr(argparse.ArgumentParser, "_check_help", None)
    if check is None:
        yield
        return

    def check_texts(parser: argparse.ArgumentParser, action: argparse.Action) -> None:
        if isinstance(action.help, str):
            check(parser, action)

    argparse.ArgumentParser._check_help = check_texts  # type: ignore[attr-defined]
    try:
        yield
    finally:
        argparse.ArgumentParser._check_help = check  # type: ignore[attr-defined]
