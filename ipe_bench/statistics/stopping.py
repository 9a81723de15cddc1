"""Runs that end when a precision is reached, and one number of what they stored for those who
optimise."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.definitions import pinned
from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.runs.execution import Execution
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute, new_name, result_keys, validate
from ipe_bench.runs.schedule import BLOCK_SIZE, Watcher
from ipe_bench.runs.store import ResultKey, describe_names
from ipe_bench.statistics.collect import collect
from ipe_bench.statistics.formulas import rmse_sequence, rmse_unseen
from ipe_bench.statistics.intervals import share_sequence
from ipe_bench.statistics.records import SCORES
from ipe_bench.statistics.registry import summary_rows
from ipe_bench.statistics.sample import Sample, samples
from ipe_bench.statistics.statistic import rows_of
from ipe_bench.trials.paths import AnyScenario
from ipe_bench.trials.scenario import MOST_TRIALS, TRIALS

NARROW = "every interval is narrow enough"
"""Reason of a scenario that stops because it has the requested precision."""
WITH_PRECISION = ("success", "rmse")
"""Statistics with a precision: success as a difference of shares, of every estimator; rmse as a
ratio less 1, of the root mean square over parameters of error over bound, of the trials that an
estimator solved."""


def precision_of(given: float | Mapping[str, float]) -> Mapping[str, float]:
    """Returns the requested precision by statistic, valid at any number of trials: from a number,
    which is that of success, or from numbers by name.

    Raises:
        UserError: it is neither.
    """
    named = (
        {str(k): v for k, v in given.items()} if isinstance(given, Mapping) else {"success": given}
    )
    for name, value in named.items():
        if name not in WITH_PRECISION:
            raise UserError(f"precision.{name}: {unknown(name, WITH_PRECISION, 'statistic')}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1:
            key = f"precision.{name}" if isinstance(given, Mapping) else "precision"
            raise UserError(f"{key}={value}: give a number between 0 and 1, such as 0.01")
    if not named:
        raise UserError("precision={}: give a number between 0 and 1, such as 0.01")
    return named


def _distances(sample: Sample, wanted: Mapping[str, float]) -> Iterator[tuple[float, str]]:
    """Computes the ratio of each statistic's interval to the requested precision, above 1 if too
    wide, and words for it."""
    for statistic, precision in wanted.items():
        if statistic == "success":
            share = float(sample.scalars["success"].mean())
            low, high = share_sequence(int(sample.scalars["success"].sum()), len(sample))
            width = max(high - share, share - low)
        else:
            low, high = (float(end[sample.n]) for end in rmse_sequence(sample))
            width = float(np.sqrt(high / low)) - 1 if low > 0 else np.inf
        known = math.isfinite(width)
        shown = (
            f"{100 * width:.2g} %"
            if known
            else "anything, since a few trials carry it or there are too few"
        )
        if known and statistic == "rmse" and (rare := float(rmse_unseen(sample)[sample.n])) > 0:
            shown += f", unless errors are larger in 1 of {1 / rare:.0f} trials or fewer"
        yield (
            width / precision if known else np.inf,
            f"{sample.group.estimator}: {statistic} ± {shown}",
        )


def compute_until(
    scenarios: Sequence[AnyScenario],
    estimators: Mapping[str, Any],
    most: int | None,
    output: Path | str,
    *,
    precision: float | Mapping[str, float] | None,
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
    and the `widest` statistic, which is farthest from it.

    Raises:
        UserError: what was asked for cannot be computed; nothing is computed then.
        StorageError: nothing can be stored any more.
    """
    # Code that fills its variables while it computes is still what it was when the run began.
    scenarios, estimators = (
        pinned(list(scenarios)),
        {label: pinned(one) for label, one in estimators.items()},
    )
    options: dict[str, Any] = {"execution": execution, "watch": watch, "command": command}
    if precision is None:
        if time_limit is not None:
            raise UserError(
                f"time_limit={time_limit}: goes with precision; give that, or leave it out"
            )
        trials = TRIALS if most is None else most
        return compute(scenarios, estimators, trials, output, block_size=block_size, **options), []
    wanted, budget, began = (
        precision_of(precision),
        MOST_TRIALS if most is None else most,
        time.monotonic(),
    )
    if time_limit is not None and not time_limit > 0:
        raise UserError(f"time_limit={time_limit}: give a number of seconds above 0")
    if any(scenario.noise.real for scenario in scenarios):
        raise UserError(f"precision={precision}: certified readings are one trial; leave it out")
    validate(scenarios, estimators, budget, block_size)
    block_size = BLOCK_SIZE if block_size is None else block_size
    options |= {"block_size": block_size, "further": {"precision": wanted}}
    at = [_first_trials(s, estimators, Path(output), block_size, budget) for s in scenarios]
    names, failures = [new_name() for _ in scenarios], []
    stops: dict[int, dict[str, Any]] = {}
    while len(stops) < len(scenarios):
        for i in [i for i in range(len(scenarios)) if i not in stops]:
            failed = compute(
                [scenarios[i]], estimators, at[i], output, record_as=names[i], **options
            )
            ratios = [
                one
                for sample in _stored(scenarios[i], estimators, output)
                for one in _distances(sample, wanted)
            ]
            ratio, widest = max(ratios, key=lambda one: one[0], default=(np.inf, ""))
            reasons = {
                "some blocks failed": failed,
                "no trial has readings": not ratios,
                NARROW: ratio <= 1,
                "there are as many trials as there may be": at[i] >= budget,
                "the time is over": time_limit is not None
                and time.monotonic() - began >= time_limit,
            }
            if reason := next((words for words, applies in reasons.items() if applies), ""):
                failures += failed
                known = {k: v for k, v in ResultKey(scenarios[i]).names.items() if k != "estimator"}
                stops[i] = known | {"trials": at[i], "reason": reason, "widest": widest}
            else:
                at[i] = next_trials(at[i], ratio, block_size, budget)
    return tuple(failures), [stops[i] for i in range(len(scenarios))]


def next_trials(trials: int, ratio: float, block: int, most: int) -> int:
    """Computes how many trials to have before looking again: what the widths ask for, at most twice
    as many as now, in whole blocks. Widths shrink with the root of the number."""
    wanted = (
        2.0 * trials if not math.isfinite(ratio) else min(2.0 * trials, 1.02 * trials * ratio**2)
    )
    return min(most, max(trials // block + 1, math.ceil(wanted / block)) * block)


def _first_trials(
    scenario: AnyScenario, estimators: Mapping[str, Any], output: Path, block_size: int, most: int
) -> int:
    """Returns the number to begin with: what is stored of every estimator, or one block."""
    cells = result_keys(scenario, estimators)
    results = Results.read([output] if output.is_dir() else [], keys={cell.key for cell in cells})
    stored = min(
        gaps[0][0] if (gaps := results.missing(cell.key, most)) else most for cell in cells
    )
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
        if sample.group.label == label:
            value = float((summary_rows(sample)[-1] | rows_of(SCORES, sample)[-1])[column])
            if np.isnan(value):
                raise UserError(
                    f"objective={label}.{column}: is not known of {describe_names(sample.group.cells[0].names)}"
                )
            return value
    raise UserError(f"objective={label}.{column}: no trials of {label} are stored")
