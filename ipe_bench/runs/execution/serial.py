"""One task after another, in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ipe_bench.runs.execution.base import FATAL, Event, Execution, Failure, Task, Work


@dataclass(frozen=True)
class Serial(Execution):
    """Runs tasks in this process; compiled models still use every core.

    Nothing stands between an estimator and this process: one that never returns, or ends the process, ends the run.
    """

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Event]:
        for index, task in enumerate(tasks):
            failure = None
            try:
                for step in work(task):
                    yield Event(index, step)
            except FATAL:
                raise
            except Exception as error:
                failure = Failure.of(error)
            yield Event(index, ended=True, failure=failure)
