"""One task after another, in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ipe_bench.estimation import describe_exception
from ipe_bench.execution.base import Execution, Outcome


@dataclass(frozen=True)
class Serial(Execution):
    """Runs tasks in this process; compiled models still use every core."""

    def run(self, work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Outcome]:
        for index, task in enumerate(tasks):
            try:
                yield Outcome(index, work(task))
            except Exception as error:
                yield Outcome(index, failure=describe_exception(error))
