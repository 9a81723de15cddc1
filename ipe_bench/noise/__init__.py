"""Adds errors to readings, and knows the covariance that estimators assume. Config group
`noise`."""

from ipe_bench.basics.errors import without_modules
from ipe_bench.noise.base import Noise
from ipe_bench.noise.kinds import (
    Certified,
    Colored,
    Correlated,
    Gaussian,
    ModelNoise,
    NoNoise,
    Outliers,
    Quantization,
    StudentT,
)
from ipe_bench.noise.unknown import Unknown

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
