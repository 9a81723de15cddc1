"""Execution: where blocks of trials run. Config group `execution`."""

from ipe_bench.execution.auto import Auto
from ipe_bench.execution.base import Event, Execution, Failure
from ipe_bench.execution.dask import Dask
from ipe_bench.execution.processes import Processes
from ipe_bench.execution.serial import Serial

__all__ = ["Auto", "Dask", "Event", "Execution", "Failure", "Processes", "Serial"]
