"""The whole bench as one function: scenarios and estimators in, a table of statistics out. It knows no Hydra."""

from __future__ import annotations

import contextlib
import datetime
import functools
import platform
import subprocess
import tempfile
import uuid
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import cores, library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.base import Measurement
from ipe_bench.noise.base import Noise
from ipe_bench.priors.gaussian import GaussianPrior
from ipe_bench.runs.execution import Execution, Serial
from ipe_bench.runs.provenance import describe, fingerprint
from ipe_bench.runs.schedule import RunLog, Watcher, perform, plan, work_through
from ipe_bench.runs.store import TRUTH, Cell, Store
from ipe_bench.trials.scenario import Scenario

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.answer import Answer

BLOCK_SIZE = 250


def run(
    scenarios: Scenario | Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int = 1000,
    *,
    output: Path | str | None = None,
    execution: Execution | None = None,
    block_size: int = BLOCK_SIZE,
    watch: Watcher | None = None,
) -> pd.DataFrame:
    """Runs every estimator on the same trials of every scenario and summarises what is known of them.

    `estimators` maps labels to estimators. What `output` holds already is not computed again; without `output` nothing
    is kept. Returns the tidy summary: a row per scenario, estimator and parameter, plus the parameter `all`. What could
    not be computed is left out, with a warning that says why.

    Raises:
        UserError: what was asked for cannot be computed; nothing has been computed then.
    """
    from ipe_bench.statistics import summarize

    scenarios = [scenarios] if isinstance(scenarios, Scenario) else list(scenarios)
    with contextlib.ExitStack() as stack:
        folder = output or stack.enter_context(tempfile.TemporaryDirectory(prefix="ipe-bench-"))
        options: dict[str, Any] = {"execution": execution, "block_size": block_size, "watch": watch}
        for failure in compute(scenarios, estimators, trials, folder, **options):
            warnings.warn(f"failed: {failure}", stacklevel=2)
        return summarize([folder])


def compute(
    scenarios: Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int,
    output: Path | str,
    *,
    execution: Execution | None = None,
    block_size: int = BLOCK_SIZE,
    watch: Watcher | None = None,
) -> tuple[str, ...]:
    """Computes and stores what is missing under `output`; returns the messages of what failed.

    Raises:
        UserError: what was asked for cannot be computed, or the folder cannot be written to; nothing is computed then.
        StorageError: nothing can be stored any more.
    """
    check(scenarios, estimators, trials, block_size)
    # Absolute: workers may have another working folder.
    store = Store(Path(output).absolute())
    store.prepare()
    execution = execution or Serial()
    tasks = [task for scenario in scenarios for task in plan(store, _cells(scenario, estimators), trials, block_size)]
    execution.warm_up(perform, len(tasks))
    identifier = _write_record(store, scenarios, estimators, trials)
    with RunLog(store.directory / "log" / f"{identifier}.log") as log:
        return work_through(tasks, execution, store, watch or (lambda progress: None), log)


def estimate(
    measurement: Measurement,
    readings: Path | str | Sequence[Path | str] | Array,
    estimators: Mapping[str, Estimator] | None = None,
    *,
    noise: Noise | None = None,
    prior: GaussianPrior | None = None,
    error_scale: float = 1.0,
) -> Answer:
    """Estimates from real readings: a file, several files that share parameters, or the readings z (m,) themselves.

    Without `noise`, what the file says of it (a column sigma) or the model; where neither does, its level is estimated.
    Without estimators, Levenberg-Marquardt. The answer shows itself in a notebook; `answer.table()` is a frame.

    Raises:
        UserError: a file does not hold readings of the model, or an estimator lacks what it needs.
    """
    from ipe_bench.baselines import LevenbergMarquardt
    from ipe_bench.noise import Gaussian, ModelNoise, Unknown
    from ipe_bench.real.examination import examine
    from ipe_bench.real.fits import fit
    from ipe_bench.real.sources import Readings, open_together
    from ipe_bench.report.answer import Answer

    if isinstance(readings, np.ndarray):
        if readings.shape != (measurement.m,):
            raise UserError(f"readings: have shape {readings.shape}, and the model has {measurement.m} readings")
        found = Readings(measurement, np.asarray(readings, dtype=float))
    else:
        paths = [readings] if isinstance(readings, str | Path) else list(readings)
        found = open_together([Path(path) for path in paths], measurement)
    if found.deviations is not None:
        known = tuple(np.where(np.isfinite(found.deviations), found.deviations, 1.0).tolist())
        if noise is not None and not isinstance(noise, Unknown):
            raise UserError("noise: is given, and the file has a column sigma, too; leave one of them out")
        noise = Unknown(known) if isinstance(noise, Unknown) else Gaussian(known)
    noise = noise or ModelNoise().of(found.model) or Unknown()
    scenario = Scenario(found.model, noise, prior or GaussianPrior(), error_scale)
    estimators = estimators or {"levenberg_marquardt": LevenbergMarquardt()}
    check([scenario], estimators, trials=1, estimating=True)
    fits = fit(scenario.problem, found.z, estimators, level_unknown=noise.estimated)
    return Answer(found.model.name, found.model, found.z, fits, examine(scenario.problem, found.z, fits))


def check(
    scenarios: Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int,
    block_size: int = BLOCK_SIZE,
    *,
    estimating: bool = False,
) -> None:
    """Raises one UserError with everything that stands in the way of this run, or of estimating from real readings."""
    mistakes = []
    if trials < 1:
        mistakes.append(f"trials={trials}: give a whole number above 0")
    if block_size < 1:
        mistakes.append(f"block_size={block_size}: give a whole number above 0")
    if not scenarios:
        mistakes.append("there is no scenario; give at least one")
    if TRUTH in estimators:
        mistakes.append(f"estimators.{TRUTH}: is what the truth itself is stored under; choose another label")
    if not estimators:
        mistakes.append("there is no estimator; choose with solver= and baseline=")
    for scenario in scenarios:
        if scenario.noise.estimated and not estimating:
            mistakes.append("noise=unknown: has no level to simulate with; choose another noise, or use `estimate`")
        if scenario.noise.real and trials != 1:
            mistakes.append(f"trials={trials}: certified readings are one trial; set trials=1")
        for label, estimator in estimators.items():
            for need in estimator.missing(scenario.problem):
                name = scenario.measurement.name
                mistakes.append(
                    f"estimators.{label}: needs {need}, which measurement={name} does not have; leave it out"
                )
    if mistakes:
        raise UserError("; ".join(dict.fromkeys(mistakes)))


def _cells(scenario: Scenario, estimators: Mapping[str, Estimator]) -> list[Cell]:
    return [Cell(scenario), *(Cell(scenario, label, estimator) for label, estimator in estimators.items())]


def _write_record(store: Store, scenarios: Sequence[Scenario], estimators: Mapping[str, Estimator], trials: int) -> str:
    """States what is going to be computed, so that what is missing later is known to be missing; returns its name."""
    now = datetime.datetime.now(datetime.UTC)
    cells = [cell for scenario in scenarios for cell in _cells(scenario, estimators)]
    record: dict[str, Any] = {
        "started": now.isoformat(timespec="microseconds"),
        "trials": trials,
        "scenarios": [describe(s) for s in scenarios],
        "estimators": {label: describe(e) for label, e in estimators.items()},
        "cells": [{"key": c.key, "identity_key": c.footer["identity_key"], "names": c.footer["names"]} for c in cells],
        "libraries": library_versions(),
        "machine": {"host": platform.node(), "system": platform.platform(), "cores": cores()},
        "git_commit": _git_commit(Path.cwd()),
        **fingerprint([*scenarios, *estimators.values()]),
    }
    identifier = f"{now:%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:8]}"
    store.write_run(identifier, record)
    return identifier


@functools.cache
def _git_commit(folder: Path) -> str | None:
    """The commit of the folder, where it is in a repository; asked once per process, as a sweep records it per job."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
