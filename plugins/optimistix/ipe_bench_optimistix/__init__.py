"""A plugin for ipe-bench: the least-squares solvers of Optimistix."""

from ipe_bench_optimistix.optimistix import Optimistix

__all__ = ["Optimistix"]
