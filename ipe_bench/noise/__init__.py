"""Noise: adds errors to readings, and knows the covariance that estimators assume. Config group `noise`."""

from ipe_bench.noise.base import Noise
from ipe_bench.noise.gaussian import Gaussian, NoNoise
from ipe_bench.noise.quantization import Quantization

__all__ = ["Gaussian", "NoNoise", "Noise", "Quantization"]
