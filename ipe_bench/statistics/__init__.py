"""Statistics: what the stored trials say about the estimators."""

from ipe_bench.statistics.analysis import Analysis, analyse, summarize

__all__ = ["Analysis", "analyse", "summarize"]
