"""Execution: where blocks of trials run. Config group `execution`."""

from ipe_bench.runs.execution.base import Event, Execution, Failure, Serial
from ipe_bench.runs.execution.processes import Auto, Processes

__all__ = ["Auto", "Event", "Execution", "Failure", "Processes", "Serial"]
