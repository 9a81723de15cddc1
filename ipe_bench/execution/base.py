"""What an execution is: it runs tasks somewhere and hands back, in any order, how each of them ended."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ipe_bench.naming import Named


@dataclass(frozen=True)
class Outcome:
    """How one task ended: its result, or the message of what stopped it."""

    index: int
    """The task's place in the sequence that was given."""
    result: Any = None
    failure: str | None = None


class Execution(Named, ABC):
    """Where tasks run. A new execution is a frozen dataclass that writes `run`."""

    @abstractmethod
    def run(self, work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Outcome]:
        """Yields an outcome per task as soon as it ends; an exception in `work` is a failure of its task alone."""
