"""Does a tracker know which of its tracks are lost, and how probable the turn of a pendulum is?

    python plugins/examples/lost_tracks/lost_tracks.py 1000

The first rows count the tracks that `auto` and `lm_ieks` lose, by the error at the last epoch, and
the shares of lost and of held ones that are reported: by the cost of the path or its status; then
by its copies a turn away, too. The others hold the probability of a path among its copies against
the share of paths whose turn is right.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

import ipe_bench as ib
from ipe_bench.states.smoothers import whole
from ipe_bench.statistics.formulas import FIT_LEVEL
from ipe_bench.statistics.intervals import clopper_pearson
from ipe_bench.trials.paths import PathBlock

SEED = 2
BLOCK = 50
POINTS = {
    "bearings_only": (30, 100),
    "coordinated_turn": (100,),
    "pendulum": (1, 4, 10),
    "walking_gins": (100,),
}
"""The error scales of each model at which tracks are lost, or turns are."""
TRACKERS = {"auto": ib.states.AutoTracker(), "lm_ieks": ib.states.LevenbergMarquardtSmoother()}
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 0.99, 1.0)
"""Limits of the probabilities among copies that are pooled."""
TURN = 2 * np.pi

Columns = dict[str, np.ndarray]


def blocks(model: str, scale: float, trials: int) -> Iterator[PathBlock]:
    scenario = ib.StateScenario(
        ib.component(f"state_model/{model}"), seed=SEED, error_scale=float(scale)
    )
    for start in range(0, trials, BLOCK):
        yield PathBlock.draw(scenario, start, min(start + BLOCK, trials))


def columns(model: str, scale: float, tracker: str, trials: int) -> Columns:
    """What is known of each trial, and, of a pendulum, how many turns the start of its path is
    off."""
    found: list[Columns] = []
    for block in blocks(model, scale, trials):
        one = block.estimate(TRACKERS[tracker])[1]
        kept = {name: one[name] for name in ("success", "status", "fit_p")}
        kept["ambiguous"] = one.get("extra_ambiguous", np.zeros(len(block))) > 0
        if model == "pendulum":
            kept["copy_p"] = one["copy_p"]
            kept["turns"] = turns(block, tracker)
        found.append(kept)
    return {name: np.concatenate([one[name] for one in found]) for name in found[0]}


def turns(block: PathBlock, tracker: str) -> np.ndarray:
    """Of the start, since a path may jump by a whole turn from one epoch to the next at no cost."""
    tracks = TRACKERS[tracker].track(block.scenario.assumed, block.paths.z)
    start = whole(tracks)[0][:, 0]
    return np.round((start - block.paths.start)[:, 0] / TURN)


def share(chosen: np.ndarray) -> str:
    """The share in per cent with its 95 % interval."""
    if not len(chosen):
        return "-"
    count = int(chosen.sum())
    low, high = clopper_pearson(count, len(chosen))
    return f"{100 * count / len(chosen):.3g} ({100 * low:.3g} to {100 * high:.3g})"


def reported(one: Columns) -> str:
    lost = ~one["success"]
    by_cost = (one["status"] != "converged") | ~(one["fit_p"] >= FIT_LEVEL)
    cells = [str(lost.sum()), share(by_cost[lost]), str((~lost).sum()), share(by_cost[~lost])]
    either = by_cost | one["ambiguous"]
    cells += [share(either[lost]), share(either[~lost])]
    return " | ".join(cells)


def reliability(pooled: Columns) -> Iterator[str]:
    p = pooled["copy_p"]
    right = pooled["turns"] == 0
    for low, high in pairwise(BINS):
        inside = (p > low) & (p <= high) & pooled["success"]
        mean = f"{100 * p[inside].mean():.3g}" if inside.any() else "-"
        yield f"{low:g} to {high:g} | {inside.sum()} | {mean} | {share(right[inside])}"


def main() -> None:
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    models = sys.argv[2:] or list(POINTS)
    pendulums: dict[str, list[Columns]] = {name: [] for name in TRACKERS}
    for model in models:
        for scale in POINTS[model]:
            for tracker in TRACKERS:
                one = columns(model, scale, tracker, trials)
                print(f"| {model} | {scale} | {tracker} | {reported(one)} |", flush=True)
                if model == "pendulum":
                    pendulums[tracker].append(one)
    for tracker, found in pendulums.items():
        if found:
            pooled = {name: np.concatenate([one[name] for one in found]) for name in found[0]}
            for row in reliability(pooled):
                print(f"| {tracker} | {row} |")


if __name__ == "__main__":
    main()
