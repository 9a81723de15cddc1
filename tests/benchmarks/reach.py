"""What `progressive` and `auto` reach on problems that their constants were not chosen on, at what
cost, and which failures they flag: `python tests/benchmarks/reach.py` prints a Markdown table.

The last four columns are those of `auto` with all four looks for other minima.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

import ipe_bench as ib
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimator
from ipe_bench.estimators.minima import WRONG_MINIMUM
from ipe_bench.noise import Gaussian
from ipe_bench.solvers import Auto, Progressive
from ipe_bench.trials.scenario import Scenario

sys.path.append(str(Path(__file__).parents[2] / "plugins" / "zoo"))
TRIALS = 60
REACHED = 6.0
"""Deviations of the estimate from the truth within which the right minimum was found."""
LINE = np.linspace(0.5, 8.0, 16).tolist()
FORMULAS = {
    "two exponentials": (
        "a*exp(-b*t) + c*exp(-d*t)",
        {"a": 5.0, "b": 0.3, "c": 3.0, "d": 1.5},
        0.05,
    ),
    "sine": ("a*sin(w*t + p)", {"a": 2.0, "w": 1.0, "p": 0.5}, 0.1),
    "logistic": ("k/(1 + exp(-r*(t - m)))", {"k": 5.0, "r": 1.0, "m": 3.0}, 0.1),
    "saturation": ("v*t/(k + t)", {"v": 5.0, "k": 2.0}, 0.1),
    "peak": ("a*exp(-((t - m)/s)**2)", {"a": 3.0, "m": 4.0, "s": 1.0}, 0.05),
}


def scenarios() -> Iterator[tuple[str, Scenario]]:
    from ipe_bench_zoo import Triad

    for scale in (10.0, 30.0, 100.0):
        yield "ranging", Scenario(ib.measurements.Ranging(), Gaussian(0.1), error_scale=scale)
    yield "triad", Scenario(Triad(), Gaussian(1e-5), error_scale=300.0)
    for name, (expression, start, deviation) in FORMULAS.items():
        model = ib.measurements.Formula(expression, start, {"t": LINE})
        for scale in (0.3, 1.0):
            yield name, Scenario(model, Gaussian(deviation), error_scale=scale)


class Outcome(NamedTuple):
    """What an estimator does in the trials of a scenario."""

    solved: float
    """Share of trials whose right minimum was found."""
    cost: float
    """Median of the simulations."""
    failures: int
    flagged: int
    """Failures that are said to have other minima of the same fit."""
    silent: int
    """Failures that nothing tells: neither their status, nor the test of the fit, nor a flag."""

    @property
    def told(self) -> float:
        """Share of trials that are solved, or say that they may not be."""
        return 1.0 - self.silent / TRIALS


def outcome(scenario: Scenario, estimator: Estimator) -> Outcome:
    """Estimates the same trials whatever the estimator."""
    trials = scenario.draw(0, TRIALS)
    with np.errstate(all="ignore"):
        found = estimator.estimate(scenario.problem, trials.z)
        deviation = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        reached = (np.abs(found.x - trials.x) / deviation).max(axis=1) < REACHED
    cost = np.median(found.simulations + scenario.measurement.jacobian_cost * found.jacobians)
    flagged = found.extras.get("ambiguous", np.zeros(TRIALS)) == 1
    loud = flagged | (found.status != Status.CONVERGED) | (found.extras["fit_p"] < WRONG_MINIMUM)
    return Outcome(
        float(reached.mean()),
        float(cost),
        int((~reached).sum()),
        int((~reached & flagged).sum()),
        int((~reached & ~loud).sum()),
    )


def main() -> None:
    compared = [Progressive(), Auto(), Auto(confirmations=4)]
    heads = "| solved | cost | failures flagged | silent "
    print("| problem | error scale " + heads * len(compared) + "|")
    print("|---|--:" + "|--:|--:|--:|--:" * len(compared) + "|")
    for name, scenario in scenarios():
        found = [outcome(scenario, one) for one in compared]
        cells = [
            f"{one.solved:.1%} | {one.cost:.0f} | {one.flagged} of {one.failures} | {one.silent}"
            for one in found
        ]
        print(f"| {name} | {scenario.error_scale:g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
