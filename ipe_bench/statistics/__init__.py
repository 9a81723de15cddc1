"""Statistics: what the stored trials say about the estimators."""

from ipe_bench.statistics.summary import summarize

__all__ = ["summarize"]
