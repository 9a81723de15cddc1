"""Defines what the command line needs to know of a question: its help, its options, and what
answers it.

A `command.py` imports what answers only when it is asked, so that help is quick.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipe_bench.estimators.base import Estimator
    from ipe_bench.report.tables.table import Part
    from ipe_bench.trials.scenario import Scenario

NAMES = tuple[str, ...]
"""The type of an option that takes several names with commas between."""


@dataclass(frozen=True)
class Asked:
    """Holds a scenario that a question is about."""

    title: str
    """Name of the model, as its user calls it."""
    scenario: Scenario
    estimators: Mapping[str, Estimator]
    trials: int | None
    """Number of trials; None unless it was given."""
    folder: Callable[[str, Any, Sequence[str]], AbstractContextManager[Path]]
    """Reserves the folder of an answer, by the name of its page, what identifies the command, and
    its further files."""
    about_estimate: bool = False
    """Whether the model starts at the estimate from a user's own readings."""


@dataclass(frozen=True)
class Answered:
    """Holds what a command shows, and its exit code."""

    parts: Iterable[Part]
    code: int
    problems: Sequence[str] = ()
    """Lines for stderr, after the parts."""
    files: Sequence[Path] = ()
    """Files that were written into one folder."""
    lines: Sequence[str] = ()
    """Lines for stdout, which come last."""


@dataclass(frozen=True)
class Question:
    """Describes the command of a question."""

    codes: str
    """Exit codes besides 2, and their meaning."""
    more: str
    """Examples and explanations of its help."""
    argument: tuple[str, str]
    """Placeholder of its arguments, and their meaning."""
    run: Callable[..., Answered]
    """Answers, given the scenario that was `Asked` or the folders and files, and the options by
    name."""
    options: Callable[[], Mapping[str, Any]]
    """Returns the types of its own options KEY=VALUE."""
