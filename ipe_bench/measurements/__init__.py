"""Measurement models: what a parameter vector makes the instruments read. Config group `measurement`."""

from ipe_bench.measurements.base import Measurement, Parameter, Restricted
from ipe_bench.measurements.gins import Gins

__all__ = ["Gins", "Measurement", "Parameter", "Restricted"]
