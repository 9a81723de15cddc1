"""Solvers: one step each of an iterative root finder. Config group `solver`."""

from ipe_bench.solvers.base import Solver, State, System
from ipe_bench.solvers.fixed_point import FixedPoint
from ipe_bench.solvers.newton import Newton

__all__ = ["FixedPoint", "Newton", "Solver", "State", "System"]
