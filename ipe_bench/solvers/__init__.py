"""Solvers: one step each of an iterative root finder. Config group `solver`.

`Relinearized` and `Progressive` are estimators that call the driver repeatedly; they stand here because they are IPE.
"""

from typing import TYPE_CHECKING, Any

from ipe_bench.solvers.anderson import Anderson
from ipe_bench.solvers.base import Solver, State, System
from ipe_bench.solvers.broyden import Broyden
from ipe_bench.solvers.damped_newton import DampedNewton
from ipe_bench.solvers.fixed_point import FixedPoint
from ipe_bench.solvers.newton import Newton
from ipe_bench.solvers.steepest_descent import SteepestDescent

if TYPE_CHECKING:
    from ipe_bench.solvers.progressive import Progressive
    from ipe_bench.solvers.relinearized import Relinearized

__all__ = [
    "Anderson",
    "Broyden",
    "DampedNewton",
    "FixedPoint",
    "Newton",
    "Progressive",
    "Relinearized",
    "Solver",
    "State",
    "SteepestDescent",
    "System",
]

_ESTIMATORS = {"Progressive": "progressive", "Relinearized": "relinearized"}


def __getattr__(name: str) -> Any:
    # Late: they need the driver, which needs this room.
    if name not in _ESTIMATORS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"{__name__}.{_ESTIMATORS[name]}"), name)
