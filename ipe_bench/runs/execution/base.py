"""What an execution is: it runs tasks somewhere and tells, in any order, how each of them gets on and ends. And the
simplest one: one task after another, in this process."""

from __future__ import annotations

import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Gt, Lt, doc

from ipe_bench.basics.errors import StorageError, UserError, describe_exception
from ipe_bench.basics.naming import Named
from ipe_bench.basics.options import Component, Count

Work = Callable[[Any], Iterable[Any]]
"""Does a task, which is anything that can be pickled, in steps: what it yields after each step is handed on."""

_LONGEST = 1e9
"""Seconds, and 1e9 bytes, beyond which no limit is meant: thirty years, and more memory than there is."""
Limit = Annotated[float, Gt(0), Lt(_LONGEST), doc(f"a number above 0 and below {_LONGEST:g}")]
"""Of time or memory."""


@dataclass(frozen=True)
class ResourceLimits:
    """What a task may use."""

    seconds: float | None = None
    """Time between two of its steps."""
    memory_gb: float | None = None
    """Memory of the process that it runs in, in 1e9 bytes; Linux only."""

    def enforce(self) -> None:
        """Has every allocation of this process beyond the limit end in a MemoryError."""
        if sys.platform.startswith("linux"):
            import resource

            # Data, not address space: compiled code and thread pools reserve far more addresses than they use.
            _, most = resource.getrlimit(resource.RLIMIT_DATA)
            limit = most if self.memory_gb is None else int(self.memory_gb * 1e9)
            resource.setrlimit(resource.RLIMIT_DATA, (limit, most))


FATAL = (UserError, StorageError)
"""Exceptions that concern the whole run: they end it, where any other is a failure of one task."""


@dataclass(frozen=True)
class Failure:
    """Why a task did not end well."""

    status: Literal["error", "timeout", "died"]
    """It raised; it exceeded a time limit; or it never began, or the process that it ran in ended."""
    message: str
    detail: str = ""
    """The traceback, where there is one."""

    @classmethod
    def of(cls, error: BaseException) -> Failure:
        return cls("error", describe_exception(error), "".join(traceback.format_exception(error)))


@dataclass(frozen=True)
class Event:
    """News of one task: a step was done, or it ended."""

    index: int
    """The task's place in the sequence that was given."""
    step: Any = None
    ended: bool = False
    failure: Failure | None = None


class Execution(Component, Named, ABC):
    """Where tasks run. A new execution is a frozen dataclass that writes `run`."""

    @abstractmethod
    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        """Yields an event per step, and one with `ended` per task; an exception in `work` fails its task alone.

        Closing the iterator, or an exception of `FATAL`, stops what is under way.
        """


@dataclass(frozen=True)
class Serial(Execution):
    """Runs tasks in this process; compiled models still use every core.

    Nothing stands between an estimator and this process: one that never returns, or ends the process, ends the run.
    """

    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        for index, task in enumerate(tasks):
            failure = None
            try:
                for step in work(task):
                    yield Event(index, step)
            except FATAL:
                raise
            except (Exception, SystemExit) as error:
                failure = Failure.of(error)
            yield Event(index, ended=True, failure=failure)


@dataclass(frozen=True)
class LimitedExecution(Execution):
    """An execution whose tasks run in worker processes, within limits."""

    workers: Count | None = None
    """How many processes; None: one per core."""
    block_timeout_s: Limit | None = None
    """Seconds that one estimator may take for one block; None: no limit."""
    memory_limit_gb: Limit | None = None
    """Memory that one worker may use, in 1e9 bytes; None: no limit. Linux only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.memory_limit_gb is not None and not sys.platform.startswith("linux"):
            raise UserError(f"memory_limit_gb={self.memory_limit_gb}: can be enforced on Linux only; give null")

    @property
    def limits(self) -> ResourceLimits:
        """What one task may use."""
        return ResourceLimits(self.block_timeout_s, self.memory_limit_gb)
