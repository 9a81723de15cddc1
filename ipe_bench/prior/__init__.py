"""Priors: where true parameters are drawn from. Config group `prior`."""

from ipe_bench.prior.gaussian import Gaussian

__all__ = ["Gaussian"]
