"""Noise: adds errors to readings, and knows the covariance that estimators assume. Config group `noise`."""

from ipe_bench.basics.naming import without_modules
from ipe_bench.noise.base import Noise
from ipe_bench.noise.colored import Colored, Correlated
from ipe_bench.noise.own import Certified, ModelNoise, Unknown
from ipe_bench.noise.white import Gaussian, NoNoise, Outliers, Quantization, StudentT

__all__ = [
    "Certified",
    "Colored",
    "Correlated",
    "Gaussian",
    "ModelNoise",
    "NoNoise",
    "Noise",
    "Outliers",
    "Quantization",
    "StudentT",
    "Unknown",
]

without_modules(__name__, __all__)
