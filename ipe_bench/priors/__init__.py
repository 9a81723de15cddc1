"""Priors: where true parameters are drawn from. Config group `prior`."""

from ipe_bench.priors.base import Prior
from ipe_bench.priors.gaussian import GaussianPrior

__all__ = ["GaussianPrior", "Prior"]
