"""Problems and rivals of kinds that ipe-bench has already, kept beside it: the mission's own stay
in the package."""

from pathlib import Path

from ipe_bench.measurements.ode.described import packaged
from ipe_bench_zoo.anderson import Anderson
from ipe_bench_zoo.es_mda import EsMda
from ipe_bench_zoo.gnss import Gnss
from ipe_bench_zoo.iterated_filters import LMIEKF, RecursiveUpdate
from ipe_bench_zoo.mgh import Mgh
from ipe_bench_zoo.multiple_shooting import MultipleShooting
from ipe_bench_zoo.triad import Accelerometer, Triad

Bock = packaged("bock", Path(__file__).parent / "conf")

__all__ = [
    "LMIEKF",
    "Accelerometer",
    "Anderson",
    "Bock",
    "EsMda",
    "Gnss",
    "Mgh",
    "MultipleShooting",
    "RecursiveUpdate",
    "Triad",
]
