"""What the constants of `auto` and `progressive` are worth: each is divided by a factor and
multiplied by it, and what is reached and its cost stand beside today's.

`python tests/benchmarks/constants.py [MODULE [NAME ...]]` prints a Markdown table; modules are
chords, starts, windows, progressive and auto.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

import numpy as np
from reach import REACHED, scenarios

import ipe_bench as ib
from ipe_bench.noise import Quantization
from ipe_bench.solvers import Auto, Progressive
from ipe_bench.trials.scenario import Scenario

FACTOR = 2.0
TRIALS = 10
"""Of each problem; the figures beside the constants of chords are of 20."""
NAMES = {
    "chords": (
        *("_ITERATIONS", "_TRIED", "_PER_DECADE", "_NEAR_ROOT", "_CHORDS"),
        *("_JACOBIANS", "_BENT", "_CONTRACTING", "_DEPTH"),
    ),
    "starts": ("LONG", "_PROMISING", "_SHORT", "_APART", "_LOOKS"),
    "windows": (
        *("_DAMPING", "_FIRST_ITERATIONS", "_FIRST_DRAWS", "_RANDOMISED"),
        *("_AS_BAD", "_CAREFUL_ITERATIONS", "_THINNING", "_GIVEN_UP", "_ONE"),
    ),
    "progressive": ("_SAME_FIT", "_BULK", "_READINGS", "_TRUSTED", "_WORTH"),
    "auto": ("_CONFIRMATIONS", "_WORTH", "_LED", "_DAMPING", "_STEPS"),
}


def cells() -> list[Scenario]:
    """Problems on which no constant was chosen, and the paper's to far beyond its scales."""
    own = [scenario for name, scenario in scenarios() if name != "triad"]
    paper = [
        Scenario(ib.measurements.Gins(), Quantization(0.02286), error_scale=scale)
        for scale in (33.0, 300.0, 3000.0)
    ]
    return [*own, *paper]


def outcome(drawn: list[tuple[Scenario, Any]], module: str) -> tuple[int, float]:
    """How many trials are solved, and the mean logarithm of the cost."""
    solved, logarithms = 0, []
    estimator = Progressive() if module in ("starts", "windows", "progressive") else Auto()
    for scenario, trials in drawn:
        found = estimator.estimate(scenario.problem, trials.z)
        deviation = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        solved += int(((np.abs(found.x - trials.x) / deviation).max(axis=1) < REACHED).sum())
        cost = found.simulations + scenario.measurement.jacobian_cost * found.jacobians
        logarithms.append(np.log(cost).mean())
    return solved, float(np.mean(logarithms))


def multiplied(value: Any, factor: float) -> Any:
    """Multiplies a constant, or every number of a tuple; a whole number stays one, 1 at least."""
    if isinstance(value, tuple):
        return tuple(multiplied(one, factor) for one in value)
    if isinstance(value, int):
        return max(int(value * factor), 1)
    return value * factor


def main(modules: list[str], names: list[str]) -> None:
    drawn = [(scenario, scenario.draw(0, TRIALS)) for scenario in cells()]
    print("| constant | value | solved, less | more | cost, less | more |")
    print("|---|--:|--:|--:|--:|--:|")
    for module in modules:
        place = import_module(f"ipe_bench.solvers.{module}")
        with np.errstate(all="ignore"):
            today = outcome(drawn, module)
            print(f"| {module} | | {today[0]} of {TRIALS * len(drawn)} | | | |", flush=True)
            for name in names or NAMES[module]:
                value = getattr(place, name)
                found = []
                for factor in (1 / FACTOR, FACTOR):
                    setattr(place, name, multiplied(value, factor))
                    found.append(outcome(drawn, module))
                    setattr(place, name, value)
                solved = [f"{one[0] - today[0]:+d}" for one in found]
                cost = [f"{np.expm1(one[1] - today[1]):+.0%}" for one in found]
                print(f"| {name} | {value} | {' | '.join([*solved, *cost])} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:2] or list(NAMES), sys.argv[2:])
