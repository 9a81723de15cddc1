"""Solves eq. (11) of IPE by different iterations. Config group `solver`."""

from ipe_bench.basics.errors import without_modules
from ipe_bench.estimators.ipe import IPE, State, System
from ipe_bench.solvers.auto import Auto
from ipe_bench.solvers.broyden import Broyden
from ipe_bench.solvers.damped_newton import DampedNewton
from ipe_bench.solvers.fixed_point import FixedPoint
from ipe_bench.solvers.newton import Newton
from ipe_bench.solvers.progressive import Progressive
from ipe_bench.solvers.relinearized import Relinearized
from ipe_bench.solvers.steepest_descent import SteepestDescent

__all__ = [
    "IPE",
    "Auto",
    "Broyden",
    "DampedNewton",
    "FixedPoint",
    "Newton",
    "Progressive",
    "Relinearized",
    "State",
    "SteepestDescent",
    "System",
]

without_modules(__name__, __all__)
