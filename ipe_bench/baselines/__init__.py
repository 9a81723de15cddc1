"""Baselines: estimators that are not IPE. Config group `baseline`.

An extended Kalman filter of constants is computed in three ways, and one of moving states in a
fourth; each has its reason. `kalman` steps filterpy's filters trial by trial, since users compare
with that library (`engine=filterpy`). `sequential` computes the same equations for all trials at
once (`engine=batched`). `information` keeps a square root of the information, which a QR
decomposition updates, for priors so wide that P - K S K' has no digits left. `states.trackers`
predicts states that move, and lends its update to `sequential`.
"""

from ipe_bench.baselines.information import IPLF
from ipe_bench.baselines.kalman import CKF, EKF, UKF, EnKF, FilterpyFilter, IteratedEKF
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
    "FilterpyFilter",
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
