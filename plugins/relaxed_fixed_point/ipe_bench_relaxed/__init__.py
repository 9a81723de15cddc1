"""A plugin for ipe-bench: fixed-point iteration with a relaxation factor."""

from ipe_bench_relaxed.relaxed import RelaxedFixedPoint

__all__ = ["RelaxedFixedPoint"]
