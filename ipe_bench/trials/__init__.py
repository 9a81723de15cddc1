"""Trials: drawing them from a scenario, and saying what an estimate of one is worth."""

from ipe_bench.trials.scenario import Scenario, Trials

__all__ = ["Scenario", "Trials"]
