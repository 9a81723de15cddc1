"""Baselines: estimators that are not IPE. Config group `baseline`."""

from ipe_bench.baselines.ckf import CKF
from ipe_bench.baselines.ekf import EKF, IteratedEKF
from ipe_bench.baselines.enkf import EnKF
from ipe_bench.baselines.es_mda import EsMda
from ipe_bench.baselines.gauss_newton import GaussNewton
from ipe_bench.baselines.iplf import IPLF
from ipe_bench.baselines.levenberg_marquardt import LevenbergMarquardt
from ipe_bench.baselines.linear_lse import LinearLSE
from ipe_bench.baselines.lm_iekf import LMIEKF
from ipe_bench.baselines.map_lm import MapLM
from ipe_bench.baselines.multiple_shooting import MultipleShooting
from ipe_bench.baselines.multiscale_lm import MultiscaleLM
from ipe_bench.baselines.multistart import Multistart
from ipe_bench.baselines.recursive_update import RecursiveUpdate
from ipe_bench.baselines.scipy_least_squares import LeastSquares
from ipe_bench.baselines.ukf import UKF
from ipe_bench.basics.naming import without_modules

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
