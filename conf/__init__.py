"""Lets Hydra name these configs: pkg://ipe_bench.conf."""
