"""Runs: what is to be computed, where, and how its results are kept."""
