"""Execution: where blocks of trials run. Config group `execution`."""

from ipe_bench.execution.base import Execution, Outcome
from ipe_bench.execution.serial import Serial

__all__ = ["Execution", "Outcome", "Serial"]
