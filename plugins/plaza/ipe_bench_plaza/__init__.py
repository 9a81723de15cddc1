"""A plugin for ipe-bench: a vehicle with odometry among radio beacons at unknown places, and a log
of one."""

from ipe_bench_plaza.plaza import Plaza

__all__ = ["Plaza"]
