"""A plugin for ipe-bench: the Kalman filters of Stone Soup, as a cross-check of ours."""

from ipe_bench_stonesoup.filters import StoneSoupEKF, StoneSoupUKF

__all__ = ["StoneSoupEKF", "StoneSoupUKF"]
