"""`ipe-bench run --dry-run`: what is stored of a job, what is missing, and about how long that takes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ipe_bench.basics.machine import cores
from ipe_bench.cli.progress import duration
from ipe_bench.cli.spec import Spec
from ipe_bench.runs.key import ResultKey
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import result_keys, validate
from ipe_bench.trials.tracking import block_of

_TRIED = 2
"""Trials that an estimator is timed on where the folder holds none of it."""
_PATIENCE_S = 4.0
"""Seconds of such trials; after that an estimator that was timed at another error scale is not timed again."""


@dataclass
class DryRun:
    """What the jobs of a command would do."""

    stored: int = 0
    missing: int = 0
    seconds: float = 0.0
    """Of one core."""
    workers: int = 1
    at_most: str = ""
    """Says so where a precision may stop a job earlier."""
    at_least: str = ""
    """Says so where an estimator was timed at an easier error scale alone."""
    tried: dict[tuple[str, str], dict[float, float]] = field(default_factory=dict)
    """Seconds per trial, of an estimator on a model, by the error scale."""
    spent: float = 0.0

    def add(self, job: Spec, title: str) -> str:
        """Notes what a job lacks; a line for people."""
        validate([job.scenario], job.estimators, job.count, job.block_size)
        cells, output = result_keys(job.scenario, job.estimators)[1:], Path(job.output)
        results = Results.read([output] if output.is_dir() else [], keys={cell.key for cell in cells})
        lacking = [sum(stop - start for start, stop in results.missing(cell.key, job.count)) for cell in cells]
        asked, missing = job.count * len(cells), sum(lacking)
        pairs = zip(cells, lacking, strict=True)
        seconds = sum(count * self._per_trial(cell, results) for cell, count in pairs if count)
        self.stored += asked - missing
        self.missing += missing
        self.seconds += seconds
        most = "" if job.precision is None else "at most "
        self.at_most = self.at_most or most
        self.workers = getattr(job.execution, "workers", None) or cores()
        more = f", {most}{missing} are missing (on one core {self.at_least}{duration(seconds)})" if missing else ""
        return f"{title}: {asked - missing} of {asked} estimates are stored{more}"

    def _per_trial(self, cell: ResultKey, results: Results) -> float:
        """Seconds: those of the trials that are stored, else of some that are tried here."""
        known, scenario = results.stored.get(cell.key), cell.scenario
        if known is not None:
            return float(np.nanmean(results.load(known, ("time_s",))["time_s"]))
        assert cell.estimator is not None
        times = self.tried.setdefault((cell.label, scenario.measurement.name), {})
        if scenario.error_scale not in times:
            if times and self.spent > _PATIENCE_S:
                self.at_least = "at least "
                return max(times.values())
            block = block_of(scenario, 0, 1 if scenario.noise.real else _TRIED)
            if not times:
                block.estimate(cell.estimator)  # compiled code is loaded
            began = time.perf_counter()
            block.estimate(cell.estimator)
            took = time.perf_counter() - began
            self.spent += took
            times[scenario.error_scale] = took / len(block)
        return times[scenario.error_scale]

    def summary(self) -> str:
        """What it comes to, in a line."""
        if not self.missing:
            return f"all {self.stored} estimates are stored; nothing would be computed"
        about = f"{self.at_least}about {duration(self.seconds / self.workers)} on {self.workers} cores"
        missing = f"{self.at_most}{self.missing} would be computed, in {about}"
        return f"{self.stored} estimates are stored, {missing}; nothing was computed now"
