"""The certified nonlinear regression problems of the NIST Statistical Reference Datasets, and how they are scored."""

from ipe_bench.measurements.nist.model import CertifiedAnswer, Nist, datasets
from ipe_bench.measurements.nist.score import Digits, digits, score

__all__ = ["CertifiedAnswer", "Digits", "Nist", "datasets", "digits", "score"]
