"""Baselines: estimators that are not IPE. Config group `baseline`."""

from ipe_bench.baselines.information import IPLF
from ipe_bench.baselines.kalman import CKF, EKF, UKF, EnKF, IteratedEKF
from ipe_bench.baselines.least_squares import (
    GaussNewton,
    LeastSquares,
    LevenbergMarquardt,
    LinearLSE,
    MapLM,
    MultiscaleLM,
    Multistart,
)
from ipe_bench.basics.errors import without_modules

__all__ = [
    "CKF",
    "EKF",
    "IPLF",
    "UKF",
    "EnKF",
    "GaussNewton",
    "IteratedEKF",
    "LeastSquares",
    "LevenbergMarquardt",
    "LinearLSE",
    "MapLM",
    "MultiscaleLM",
    "Multistart",
]

without_modules(__name__, __all__)
