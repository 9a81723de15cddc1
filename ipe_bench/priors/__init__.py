"""Priors: where true parameters are drawn from. Config group `prior`."""

from ipe_bench.priors.base import Prior
from ipe_bench.priors.gaussian import GaussianPrior, prior_of

__all__ = ["GaussianPrior", "Prior", "prior_of"]
