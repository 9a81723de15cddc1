"""Noise: adds errors to readings, and knows the covariance that estimators assume. Config group `noise`."""

from ipe_bench.noise.base import Noise
from ipe_bench.noise.certified import Certified
from ipe_bench.noise.colored import Colored, Correlated
from ipe_bench.noise.gaussian import Gaussian, NoNoise
from ipe_bench.noise.outliers import Outliers
from ipe_bench.noise.own import ModelNoise, Unknown
from ipe_bench.noise.quantization import Quantization
from ipe_bench.noise.student_t import StudentT

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
