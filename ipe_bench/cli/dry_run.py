"""`ipe-bench run --dry-run`: what is stored of a job, what is missing, and about how long that takes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ipe_bench.basics.machine import cores
from ipe_bench.cli.spec import Spec
from ipe_bench.runs.key import ResultKey
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import result_keys, validate
from ipe_bench.runs.schedule import plan
from ipe_bench.trials.scoring import Block

_TRIED = 4
"""Trials that an estimator is timed on where the folder holds none of it."""


@dataclass
class DryRun:
    """What the jobs of a command would do."""

    stored: int = 0
    missing: int = 0
    seconds: float = 0.0
    """Of one core."""
    workers: int = 1
    most: str = ""
    """Says so where a precision may stop a job earlier."""
    tried: dict[tuple[str, str, float], float] = field(default_factory=dict)
    """Seconds per trial, by what they depend on most."""

    def add(self, job: Spec, title: str) -> str:
        """Notes what a job lacks; a line for people."""
        validate([job.scenario], job.estimators, job.count, job.block_size)
        cells, output = result_keys(job.scenario, job.estimators), Path(job.output)
        results = Results.read([output] if output.is_dir() else [], keys={cell.key for cell in cells})
        lacking = dict.fromkeys((cell.key for cell in cells if cell.estimator is not None), 0)
        for task in plan(output, cells, results, job.count, job.block_size):
            for cell in task.cells:
                if cell.key in lacking:
                    lacking[cell.key] += task.stop - task.start
        asked, missing = job.count * len(lacking), sum(lacking.values())
        seconds = sum(lacking[c.key] * self._per_trial(c, results) for c in cells if lacking.get(c.key))
        self.stored += asked - missing
        self.missing += missing
        self.seconds += seconds
        most = "" if job.precision is None else "at most "
        self.most = self.most or most
        self.workers = getattr(job.execution, "workers", None) or cores()
        more = f", {most}{missing} are missing (on one core {duration(seconds)})" if missing else ""
        return f"{title}: {asked - missing} of {asked} estimates are stored{more}"

    def _per_trial(self, cell: ResultKey, results: Results) -> float:
        """Seconds: those of the trials that are stored, else of some that are tried here."""
        known, scenario = results.stored.get(cell.key), cell.scenario
        if known is not None:
            return float(np.nanmean(results.load(known, ("time_s",))["time_s"]))
        place = (cell.label, scenario.measurement.name, scenario.error_scale)
        if place not in self.tried and cell.estimator is not None:
            block = Block.draw(scenario, 0, 1 if scenario.noise.real else _TRIED)
            block.estimate(cell.estimator)  # compiled code is loaded
            began = time.perf_counter()
            block.estimate(cell.estimator)
            self.tried[place] = (time.perf_counter() - began) / len(block.trials.x)
        return self.tried[place]

    def summary(self) -> str:
        """What it comes to, in a line."""
        if not self.missing:
            return f"all {self.stored} estimates are stored; nothing would be computed"
        return (
            f"{self.stored} estimates are stored, {self.most}{self.missing} would be computed, in about "
            f"{duration(self.seconds / self.workers)} on {self.workers} cores; nothing was computed now"
        )


def duration(seconds: float) -> str:
    """About how long, for people."""
    for size, unit in ((86_400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.2g} {unit}"
    return "a moment" if seconds < 0.1 else f"{seconds:.2g} s"
