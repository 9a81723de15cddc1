"""Runs that end when a precision is reached, and one number of what they stored for those who
optimise."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ipe_bench.basics.definitions import pinned
from ipe_bench.basics.errors import UserError
from ipe_bench.runs.execution import Execution
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute, new_name, result_keys, validate
from ipe_bench.runs.schedule import BLOCK_SIZE, Watcher
from ipe_bench.runs.store import ResultKey, describe_names
from ipe_bench.statistics.collect import collect
from ipe_bench.statistics.intervals import share_sequence
from ipe_bench.statistics.records import SCORES
from ipe_bench.statistics.registry import summary_rows
from ipe_bench.statistics.sample import Sample, samples
from ipe_bench.statistics.statistic import rows_of
from ipe_bench.trials.paths import AnyScenario
from ipe_bench.trials.scenario import MOST_TRIALS, TRIALS

NARROW = "every interval is narrow enough"
"""Reason of a scenario that stops because it has the requested precision."""


def require_precision(given: Any) -> None:
    """Refuses what is no half of the width that an interval of success is to have."""
    is_number = isinstance(given, int | float) and not isinstance(given, bool)
    if not is_number or not 0 < given < 1:
        raise UserError(f"precision={given}: give a number between 0 and 1, such as 0.01")


class Distance(NamedTuple):
    """Tells how far an estimator's interval of success is from the requested precision."""

    ratio: float
    """Half its width over the precision, above 1 if it is too wide."""
    words: str


NO_READINGS = Distance(math.inf, "")


def _distance(sample: Sample, precision: float) -> Distance:
    """Computes the distance from an interval that is valid at any number of trials."""
    success = sample.scalars["success"]
    share = float(success.mean())
    low, high = share_sequence(int(success.sum()), len(sample))
    width = max(high - share, share - low)
    words = f"{sample.group.estimator}: success ± {100 * width:.2g} %"
    return Distance(width / precision, words)


def compute_until(
    scenarios: Sequence[AnyScenario],
    estimators: Mapping[str, Any],
    most: int | None,
    output: Path | str,
    *,
    precision: float | None,
    time_limit: float | None = None,
    execution: Execution | None = None,
    block_size: int | None = None,
    watch: Watcher | None = None,
    command: str | None = None,
) -> tuple[tuple[str, ...], list[dict[str, Any]]]:
    """Adds blocks to what is stored under `output` until every interval is narrow enough, there are
    `most` trials (`MOST_TRIALS` where None), or `time_limit` seconds are over, which is looked at
    between rounds of blocks; without a precision until there are `most` trials (`TRIALS` where
    None).

    Returns the messages of what failed, and a row per scenario that has a precision: its names, how
    many `trials` it took, the `reason` why it took no more, `NARROW` if the precision is reached,
    and the `widest` interval, which is farthest from it.

    Raises:
        UserError: what was asked for cannot be computed; nothing is computed then.
        StorageError: nothing can be stored any more.
    """
    # Code that fills its variables while it computes is still what it was when the run began.
    scenarios = pinned(list(scenarios))
    estimators = {label: pinned(one) for label, one in estimators.items()}
    options: dict[str, Any] = {"execution": execution, "watch": watch, "command": command}
    if precision is None:
        if time_limit is not None:
            raise UserError(
                f"time_limit={time_limit}: goes with precision; give that, or leave it out"
            )
        trials = TRIALS if most is None else most
        return compute(scenarios, estimators, trials, output, block_size=block_size, **options), []
    require_precision(precision)
    budget = MOST_TRIALS if most is None else most
    if time_limit is not None and not time_limit > 0:
        raise UserError(f"time_limit={time_limit}: give a number of seconds above 0")
    if any(scenario.noise.real for scenario in scenarios):
        raise UserError(f"precision={precision}: certified readings are one trial; leave it out")
    end = math.inf if time_limit is None else time.monotonic() + time_limit
    validate(scenarios, estimators, budget, block_size)
    block_size = BLOCK_SIZE if block_size is None else block_size
    options |= {"block_size": block_size, "further": {"precision": precision}}
    at = [_first_trials(s, estimators, Path(output), block_size, budget) for s in scenarios]
    names = [new_name() for _ in scenarios]
    failures = []
    stops: dict[int, dict[str, Any]] = {}
    # Each round adds blocks to every scenario that goes on, so that all share the time.
    while len(stops) < len(scenarios):
        for i, scenario in enumerate(scenarios):
            if i in stops:
                continue
            failed = compute([scenario], estimators, at[i], output, record_as=names[i], **options)
            stored = _stored(scenario, estimators, output)
            distances = [_distance(sample, precision) for sample in stored]
            widest = max(distances, key=lambda one: one.ratio, default=NO_READINGS)
            full = at[i] >= budget
            reason = _reason_to_stop(failed, widest, full, late=time.monotonic() >= end)
            if reason:
                failures += failed
                row = {"trials": at[i], "reason": reason, "widest": widest.words}
                stops[i] = ResultKey(scenario).names | row
                del stops[i]["estimator"]
            else:
                at[i] = next_trials(at[i], widest.ratio, block_size, budget)
    return tuple(failures), [stops[i] for i in range(len(scenarios))]


def _reason_to_stop(failed: Sequence[str], widest: Distance, full: bool, late: bool) -> str:
    """Returns why a scenario gets no more trials; empty if it does."""
    if failed:
        return "some blocks failed"
    if widest is NO_READINGS:
        return "no trial has readings"
    if widest.ratio <= 1:
        return NARROW
    if full:
        return "the largest number of trials is reached"
    return "the time is over" if late else ""


def next_trials(trials: int, ratio: float, block: int, most: int) -> int:
    """Computes how many trials to have before looking again: what the widths ask for, at most twice
    as many as now, in whole blocks. Widths shrink with the root of the number."""
    wanted = 2.0 * trials
    if math.isfinite(ratio):
        wanted = min(wanted, 1.02 * trials * ratio**2)
    blocks = max(trials // block + 1, math.ceil(wanted / block))
    return min(most, blocks * block)


def _first_trials(
    scenario: AnyScenario, estimators: Mapping[str, Any], output: Path, block_size: int, most: int
) -> int:
    """Returns the number to begin with: what is stored of every estimator, or one block."""
    cells = result_keys(scenario, estimators)
    folders = [output] if output.is_dir() else []
    results = Results.read(folders, keys={cell.key for cell in cells})
    stored = most
    for cell in cells:
        missing = results.missing(cell.key, most)
        if missing:
            # Trials are stored without a gap up to the first that is missing.
            stored = min(stored, missing[0][0])
    return min(most, max(stored, block_size))


def _stored(
    scenario: AnyScenario, estimators: Mapping[str, Any], output: Path | str
) -> Iterator[Sample]:
    """Returns the stored trials of every estimator that has some."""
    collection = collect([output], {cell.key for cell in result_keys(scenario, estimators)})
    return samples(collection, collection.groups)


def objective(
    scenario: AnyScenario,
    estimators: Mapping[str, Any],
    label: str,
    column: str,
    output: Path | str,
) -> float:
    """Returns one number for an estimator: a column of its row over all parameters, of all stored
    trials.

    Columns that compare estimators, such as capped_error, are over the trials that all of these
    estimators have.

    Raises:
        UserError: nothing is stored, or the number is not known.
    """
    for sample in _stored(scenario, estimators, output):
        if sample.group.label != label:
            continue
        row = summary_rows(sample)[-1] | rows_of(SCORES, sample)[-1]
        value = float(row[column])
        if np.isnan(value):
            names = describe_names(sample.group.cells[0].names)
            raise UserError(f"objective={label}.{column}: is not known of {names}")
        return value
    raise UserError(f"objective={label}.{column}: no trials of {label} are stored")
