"""The default: worker processes where there is something to share out or to guard against, else this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ipe_bench.runs.execution.base import Event, Limits, Task, Work
from ipe_bench.runs.execution.processes import Processes
from ipe_bench.runs.execution.serial import Serial


@dataclass(frozen=True)
class Auto(Processes):
    """Worker processes as in `Processes`, except that a single task that is trusted runs in this process.

    A worker takes seconds to start, which a job of one block does not win back; compiled models use every core without.
    """

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Event]:
        if len(tasks) == 1 and self.limits == Limits() and tasks[0].trusted:
            return Serial().run(work, tasks)
        return super().run(work, tasks)

    def warm_up(self, work: Work, tasks: int) -> None:
        if tasks > 1:
            super().warm_up(work, tasks)
