"""Baselines: estimators that are not IPE. Config group `baseline`."""

from ipe_bench.baselines.linear_lse import LinearLSE

__all__ = ["LinearLSE"]
