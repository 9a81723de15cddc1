"""The least-squares test functions of Moré, Garbow and Hillstrom, and whether an estimate attains their minima."""

from ipe_bench.measurements.mgh.model import Mgh, functions
from ipe_bench.measurements.mgh.problems import Minimum
from ipe_bench.measurements.mgh.score import Attained, score

__all__ = ["Attained", "Mgh", "Minimum", "functions", "score"]
