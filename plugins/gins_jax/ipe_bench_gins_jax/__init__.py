"""A plugin for ipe-bench: the gimballed INS once more, in jax.numpy."""

from ipe_bench_gins_jax.gins import GinsJax

__all__ = ["GinsJax"]
