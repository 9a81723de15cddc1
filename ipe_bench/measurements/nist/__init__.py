"""The certified nonlinear regression problems of the NIST Statistical Reference Datasets, and how they are scored."""

from ipe_bench.measurements.nist.model import Certified, Nist, datasets
from ipe_bench.measurements.nist.score import Digits, digits, score

__all__ = ["Certified", "Digits", "Nist", "datasets", "digits", "score"]
