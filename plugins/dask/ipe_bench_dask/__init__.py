"""A plugin for ipe-bench: blocks of trials on the workers of a Dask cluster."""

from ipe_bench_dask.cluster import Dask

__all__ = ["Dask"]
