"""A plugin for ipe-bench: a pendulum that swings far, as a model by differential equations."""

from ipe_bench_pendulum.pendulum import Pendulum

__all__ = ["Pendulum"]
