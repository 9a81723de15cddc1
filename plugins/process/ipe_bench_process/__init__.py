"""A plugin for ipe-bench: an estimator in any language, run as a process."""

from ipe_bench_process.process import Process

__all__ = ["Process"]
