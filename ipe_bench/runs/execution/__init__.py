"""Execution: where blocks of trials run. Config group `execution`."""

from ipe_bench.runs.execution.auto import Auto
from ipe_bench.runs.execution.base import Event, Execution, Failure
from ipe_bench.runs.execution.dask import Dask
from ipe_bench.runs.execution.processes import Processes
from ipe_bench.runs.execution.serial import Serial

__all__ = ["Auto", "Dask", "Event", "Execution", "Failure", "Processes", "Serial"]
