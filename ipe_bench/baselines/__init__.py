"""Baselines: estimators that are not IPE. Config group `baseline`."""

from ipe_bench.baselines.es_mda import EsMda
from ipe_bench.baselines.information import IPLF, LMIEKF, RecursiveUpdate
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
from ipe_bench.baselines.multiple_shooting import MultipleShooting
from ipe_bench.basics.errors import without_modules

__all__ = [
    "CKF",
    "EKF",
    "IPLF",
    "LMIEKF",
    "UKF",
    "EnKF",
    "EsMda",
    "GaussNewton",
    "IteratedEKF",
    "LeastSquares",
    "LevenbergMarquardt",
    "LinearLSE",
    "MapLM",
    "MultipleShooting",
    "MultiscaleLM",
    "Multistart",
    "RecursiveUpdate",
]

without_modules(__name__, __all__)
