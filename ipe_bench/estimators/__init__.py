"""Holds what every estimator is, the loop that iterates them, the paper's equation (11), and least
squares."""

from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.ipe import IPE

__all__ = ["IPE", "Estimates", "Estimator"]
