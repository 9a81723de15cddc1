"""The whole bench as functions: what the command line does, it does by these. They know no Hydra."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import platform
import subprocess
import tempfile
import uuid
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.errors import StorageError, UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import cores, library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise
from ipe_bench.noise.gaussian import Gaussian
from ipe_bench.priors.gaussian import GaussianPrior
from ipe_bench.runs.execution import Execution, Serial
from ipe_bench.runs.provenance import describe, fingerprint
from ipe_bench.runs.results import Results, require_results
from ipe_bench.runs.schedule import RunLog, Watcher, perform, plan, work_through
from ipe_bench.runs.store import TRUTH, Cell, Store
from ipe_bench.trials.bounds import linear_bound
from ipe_bench.trials.scenario import Scenario

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.plugins.conformance import Finding
    from ipe_bench.real.fits import Fit
    from ipe_bench.report import ReportResult
    from ipe_bench.trials.design import Criterion, Design
    from ipe_bench.trials.posterior import Reference

BLOCK_SIZE = 250
Directories = Path | str | Sequence[Path | str]
MOST_BLOCKS = 1_000_000
_FEW = 4
LARGEST = 1e100
"""Beyond it, or below its inverse, squares and products of squares are no numbers any more."""


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
    is kept. Returns the tidy summary: a row per scenario, estimator and parameter, plus the parameter `all`, the root
    mean square over parameters of error over bound; `rmse` and its kin are in the parameter's own unit. What could not
    be computed is left out, with a warning that says why.

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> table = ib.run(bench, {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}, trials=20)
    >>> table[table["parameter"] == "all"].set_index("estimator")["converged"].to_dict()
    {'newton': 1.0, 'linear': 1.0}

    Raises:
        UserError: what was asked for cannot be computed; nothing has been computed then.
        StorageError: nothing can be stored any more.
    """
    from ipe_bench.statistics import summarize

    scenarios = [scenarios] if isinstance(scenarios, Scenario) else list(scenarios)
    with contextlib.ExitStack() as stack:
        folder = output or stack.enter_context(tempfile.TemporaryDirectory(prefix="ipe-bench-"))
        options: dict[str, Any] = {"execution": execution, "block_size": block_size, "watch": watch}
        for failure in compute(scenarios, estimators, trials, folder, **options):
            warnings.warn(f"failed: {failure}", stacklevel=2)
        return summarize([folder])


def load(directories: Directories) -> pd.DataFrame:
    """Every stored trial of one directory or of several: a row per trial and estimator.

    Columns that say what a row belongs to: measurement, noise, prior, error_scale, seed, estimator, every key of the
    config that differs between scenarios, and `estimator.KEY` for options that differ under one label. Then what the
    trial came to: `error_NAME` and `deviation_NAME` (as the estimator reports it) per parameter, status, message,
    iterations, simulations, jacobians, time_s, crlb_distance, nees, fit_p, solved, success; and the truth `x_NAME` with
    its bounds `crlb_NAME` and `bayes_NAME`. Parameters are in multiples of their sizes. What a row does not have is
    NaN. What is missing or damaged is a warning, and stale results are left out.

    >>> import tempfile, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ib.run(bench, {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}, 20, output=folder)
    ...     rows = ib.load(folder)
    >>> rows.groupby("estimator", sort=False)["trial"].count().to_dict()
    {'newton': 20, 'linear': 20}
    >>> rows["measurement"].unique().tolist(), bool((rows["x_c0"] + rows["error_c0"]).notna().all())
    (['polynomial'], True)

    Raises:
        UserError: no run ever wrote to a directory.
    """
    from ipe_bench.statistics.collect import collect, trials_frame

    paths = _paths(directories)
    require_results(paths)
    collection = collect(paths)
    frame = trials_frame(collection)
    for problem in collection.problems:
        warnings.warn(problem, stacklevel=2)
    return frame


def report(directories: Directories, output: Path | str | None = None) -> ReportResult:
    """Writes summary.csv, tables/, figures/ and report.html from what is stored, into `output` or the first directory.

    The result names the files, and has the summary itself and a line per piece that is missing, failed or damaged.

    >>> import ipe_bench as ib
    >>> ib.report("outputs/nowhere")
    Traceback (most recent call last):
    ipe_bench.basics.errors.UserError: outputs/nowhere: holds no results of ipe-bench; give the output folder of a run

    Raises:
        UserError: no run ever wrote to a directory.
        StorageError: the files cannot be written.
    """
    from ipe_bench.report import write_report

    require_results(_paths(directories))
    return write_report(directories, output)


def status(directories: Directories) -> pd.DataFrame:
    """How far everything is that runs asked for: a row per scenario and estimator.

    Columns: measurement, noise, prior, error_scale, seed, estimator (`truth` for the truth and its bounds); the numbers
    of trials `expected`, `done`, `missing`, `failed` and `stale`; and `messages`, why trials failed. The list
    `attrs["problems"]` has a line for everything that is missing, failed or damaged; it is empty where all is there.

    >>> import tempfile, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ib.run(bench, {"newton": ib.solvers.Newton()}, trials=20, output=folder)
    ...     table = ib.status(folder)
    >>> table[["estimator", "expected", "done"]].values.tolist(), table.attrs["problems"]
    ([['truth', 20, 20], ['newton', 20, 20]], [])

    Raises:
        UserError: no run ever wrote to a directory.
    """
    import pandas as pd

    paths = _paths(directories)
    require_results(paths)
    results = Results.read(paths)
    counts = ("expected", "done", "missing", "failed", "stale")
    rows = [
        {**cell.names, **{name: getattr(cell, name) for name in counts}, "messages": "; ".join(cell.messages)}
        for cell in results.cells
    ]
    frame = pd.DataFrame(rows)
    frame.attrs["problems"] = results.problems
    return frame


def estimate(
    model: Measurement,
    readings: Path | str | Array,
    estimators: Mapping[str, Estimator] | None = None,
    *,
    noise: Noise | None = None,
    prior: GaussianPrior | None = None,
    error_scale: float | None = None,
) -> list[Fit]:
    """Parameters from real readings, by every estimator: estimates, standard errors, residuals and a test of the fit.

    `readings` is a CSV file (see `ipe_bench.real.readings`) or an array z (m,) in the model's order and unit; NaN is
    missing. Without `estimators`: `linear_lse`, `fixed_point`, `levenberg_marquardt` and `progressive`. `noise` states
    R. Without it the readings are taken for independent and equally noisy, and their deviation is estimated from the
    smallest residuals that an estimator leaves; then nothing is left to test the fit with, and `chi_square` is NaN.
    Filters and `map_lm` need to know how far from the model's nominal point the parameters may be: `error_scale` is the
    standard deviation of each in multiples of its size, and `prior` widens or narrows some. `x` and `covariance` of a
    fit are in the parameters' own units.

    >>> import ipe_bench as ib
    >>> model = ib.measurements.Polynomial()
    >>> trial = ib.Scenario(model, ib.noise.Gaussian(0.01), error_scale=3.0).draw(0, 1)
    >>> for fit in ib.estimate(model, trial.z[0], noise=ib.noise.Gaussian(0.01)):
    ...     print(fit.label, fit.status.label, fit.fits)
    linear_lse converged False
    fixed_point converged True
    levenberg_marquardt converged True
    progressive converged True

    Raises:
        UserError: the file does not hold this model's readings, the array has another shape, or an estimator needs
            what is not given.
    """
    from ipe_bench.baselines import LevenbergMarquardt, LinearLSE
    from ipe_bench.real.fits import fit
    from ipe_bench.real.readings import read_readings
    from ipe_bench.solvers import FixedPoint, Progressive

    if estimators is None:
        estimators = {
            "linear_lse": LinearLSE(),
            "fixed_point": FixedPoint(),
            "levenberg_marquardt": LevenbergMarquardt(),
            "progressive": Progressive(),
        }
    z = read_readings(Path(readings), model) if isinstance(readings, Path | str) else np.array(readings, dtype=float)
    if z.shape != (model.m,):
        raise UserError(
            f"readings: has shape {z.shape}; give the {model.m} readings of {model.name}, NaN where missing"
        )
    problem = _real_problem(model, noise or Gaussian(1.0), prior, error_scale)
    if lacking := _needs(problem, estimators):
        remedy = "; give error_scale" if error_scale is None and prior is None else ""
        raise UserError("; ".join(lacking) + remedy)
    if noise is not None:
        return fit(problem, z, estimators, noise)
    # The first round weighs all readings alike, which is all that finding the deviation takes.
    found = [f.residual_deviation for f in fit(problem, z, estimators)]
    deviation = np.nanmin(found) if np.isfinite(found).any() else np.nan
    if not deviation > 0:
        raise UserError("noise: is not given and cannot be estimated from the residuals; state it, as in Gaussian(0.1)")
    problem = _real_problem(model, Gaussian(float(deviation)), prior, error_scale)
    return [dataclasses.replace(f, chi_square=np.nan, p_value=np.nan) for f in fit(problem, z, estimators)]


def _real_problem(model: Measurement, noise: Noise, prior: GaussianPrior | None, error_scale: float | None) -> Problem:
    """What estimators are told where readings are real: a prior only where somebody states one."""
    known = prior is not None or error_scale is not None
    scale = 1.0 if error_scale is None else error_scale
    problem = Scenario(model, noise, prior or GaussianPrior(), scale).problem
    return problem if known else dataclasses.replace(problem, prior_deviation=None)


def design(
    scenario: Scenario,
    *,
    by: Sequence[str] | None = None,
    readings: int | None = None,
    criterion: Criterion = "A",
    errors: Sequence[Measurement] = (),
) -> Design:
    """What a scenario's readings say about each parameter, and which readings would say more; nothing is simulated.

    The result has `observability` (singular values, bounds, correlations, the least observable direction),
    `suspects` (what each error of the richer models `errors` does to the estimates, and whether a test of residuals
    will notice), `ways` and `effects`. A way chooses by one column of the model's index, all else as today, or
    reading by reading; `by` names the columns of one way instead. Its `saving` is the choice of fewest readings whose
    mean bound is not above today's, its `sharpest` the smallest mean bound with `readings` readings (today's number
    where it is None); both say below which bound no choice can go. `measurement(choice)` is the model with those
    readings.
    Bounds are averaged over truths from the prior: as squares over parameters in units of today's bound
    (`criterion` A), or as the volume of the ellipsoid (D).

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> found = ib.design(bench, readings=20)
    >>> half = found.best.sharpest
    >>> half.readings, bench.measurement.m, half.mean_bound < 2**0.5
    (20, 40, True)
    >>> ib.Scenario(found.measurement(half), bench.noise, error_scale=3.0).draw(0, 5).z.shape
    (5, 20)

    Raises:
        UserError: the errors of readings are correlated, a column is unknown, or there are too few readings.
    """
    from ipe_bench.trials.design import design as designed

    return designed(scenario, by=by, readings=readings, criterion=criterion, errors=errors)


def posterior(
    scenario: Scenario, estimators: Mapping[str, Estimator], trials: int = 3, *, particles: int = 1000
) -> list[Reference]:
    """What the readings of a scenario's first trials really say, and how far each estimator's Gaussian is from it.

    The posterior is sampled by sequential Monte Carlo, with nothing linearised, for the normal errors of covariance R
    that estimators are told. A result has the trial's `truth` (n,), the `posterior` (draws `x` (draws, n) in multiples
    of the parameters' sizes, `mean`, `covariance`, `modes` with their `shares`, and whether it has `settled`: two
    populations of particles agree), and for each estimator its `estimates` and a `divergences` entry: `kl` in nats,
    `shift`, `width` and `energy`.

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> (found,) = ib.posterior(bench, {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}, trials=1)
    >>> found.posterior.settled, len(found.posterior.modes)
    (True, 1)
    >>> found.divergences["newton"].kl < 1 < found.divergences["linear"].kl
    True

    Raises:
        UserError: the scenario has no prior, an estimator needs what is not there, or there are too few particles.
    """
    from ipe_bench.trials.posterior import reference

    validate([scenario], estimators, trials)
    return [reference(scenario, estimators, trial, particles) for trial in range(trials)]


def check(component: Any) -> list[Finding]:
    """Whether a component keeps the promises that every component makes: a finding per check, with its complaint.

    `component` is a measurement model, noise, prior or estimator, or the folder of a plugin, all of whose options are
    checked. A finding whose `complaint` is empty passed.

    >>> import ipe_bench as ib
    >>> findings = ib.check(ib.noise.Gaussian(0.1))
    >>> [f.check for f in findings if f.complaint]
    []

    Raises:
        UserError: there is no plugin in the folder.
    """
    from ipe_bench.plugins.conformance import check_component, check_option
    from ipe_bench.plugins.discovery import options_in

    if isinstance(component, Path | str):
        return [finding for option in options_in(Path(component)) for finding in check_option(option)]
    return list(check_component(getattr(component, "name", type(component).__name__), component))


def _paths(directories: Directories) -> list[Path]:
    return [Path(d) for d in ([directories] if isinstance(directories, Path | str) else directories)]


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
    # What is stored of a scenario shows that its numbers can be computed with, without drawing any.
    stored = [any(Path(output).glob(f"trials/{Cell(scenario).key}-*.parquet")) for scenario in scenarios]
    untried = [scenario for scenario, known in zip(scenarios, stored, strict=True) if not known]
    validate(scenarios, estimators, trials, block_size, untried=untried)
    # Absolute: workers may have another working folder.
    store = Store(Path(output).absolute())
    store.prepare()
    execution = execution or Serial()
    cells = [cells_of(scenario, estimators) for scenario in scenarios]
    results = Results.read([store.directory], keys={cell.key for part in cells for cell in part})
    aside = results.set_aside()
    tasks = [task for part in cells for task in plan(store.directory, part, results, trials, block_size)]
    execution.warm_up(perform, len(tasks))
    record = _record(scenarios, estimators, trials)
    identifier = (None if tasks or aside else store.same_run(record)) or _write_record(store, record)
    with RunLog(store.directory / "log" / f"{identifier}.log") as log:
        for line in aside:
            log.warning(line)
        failures = work_through(tasks, execution, store, watch or (lambda progress: None), log)
    store.require()
    if not (store.runs / f"{identifier}.json").is_file():
        raise StorageError(f"{store.directory}: lost the record of this run; the same command computes what is missing")
    return failures


def validate(
    scenarios: Sequence[Scenario],
    estimators: Mapping[str, Estimator],
    trials: int,
    block_size: int = BLOCK_SIZE,
    *,
    untried: Sequence[Scenario] | None = None,
) -> None:
    """Raises one UserError with everything that stands in the way of this run.

    Trials are drawn of the scenarios `untried` (all where it is None), to see whether numbers hold what is asked for.
    """
    mistakes = []
    if trials < 1:
        mistakes.append(f"trials={trials}: give a whole number above 0")
    if block_size < 1:
        mistakes.append(f"block_size={block_size}: give a whole number above 0")
    elif trials > MOST_BLOCKS * block_size:
        mistakes.append(f"trials={trials}: are more than {MOST_BLOCKS} blocks of block_size={block_size}")
    if not scenarios:
        mistakes.append("there is no scenario; give at least one")
    if TRUTH in estimators:
        mistakes.append(f"estimators.{TRUTH}: is what the truth itself is stored under; choose another label")
    if not estimators:
        mistakes.append("there is no estimator; choose with solver= and baseline=")
    for scenario in scenarios:
        if scenario.noise.real and trials != 1:
            mistakes.append(f"trials={trials}: certified readings are one trial; set trials=1")
        if untried is None or scenario in untried:
            mistakes += _beyond_numbers(scenario)
        mistakes += _needs(scenario.problem, estimators)
    if mistakes:
        raise UserError("; ".join(dict.fromkeys(mistakes)))


def _needs(problem: Problem, estimators: Mapping[str, Estimator]) -> list[str]:
    """A line for everything that an estimator needs and the problem does not have."""
    return [
        f"estimators.{label}: needs {need}, which measurement={problem.measurement.name} does not have; leave it out"
        for label, estimator in estimators.items()
        for need in estimator.missing(problem)
    ]


def _beyond_numbers(scenario: Scenario) -> Iterator[str]:
    """Scales at which every statistic would be infinite or 0, as no number holds their squares."""
    if scenario.error_scale > LARGEST:
        yield f"error_scale={scenario.error_scale:g}: its square overflows; give a number up to {LARGEST:g}"
        return
    model = scenario.measurement
    with np.errstate(all="ignore"):
        bound = linear_bound(scenario.problem)
        try:
            few = scenario.draw(0, 1 if scenario.noise.real else _FEW)
        except UserError:
            raise
        except Exception:  # what cannot be drawn is a failure of its blocks, and told of there
            return
    if not scenario.noise.real and not np.isfinite(few.z).all(axis=1).any():
        yield f"measurement={model.name}: none of the first {_FEW} trials has finite readings; choose smaller scales"
    for parameter, deviation in zip(model.parameters, bound, strict=True):
        if not 1 / LARGEST <= deviation <= LARGEST and deviation != 0:
            yield (
                f"noise={scenario.noise.name}: {parameter.name} has a linear bound of {deviation:g} of its size, "
                "whose square is beyond numbers; choose another scale of the noise"
            )
            return


def cells_of(scenario: Scenario, estimators: Mapping[str, Estimator]) -> list[Cell]:
    """What a run stores of one scenario: its truth, and each estimator."""
    return [Cell(scenario), *(Cell(scenario, label, estimator) for label, estimator in estimators.items())]


def _write_record(store: Store, record: Mapping[str, Any]) -> str:
    """States what is going to be computed, so that what is missing later is known to be missing; returns its name."""
    now = datetime.datetime.now(datetime.UTC)
    identifier = f"{now:%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:8]}"
    store.write_run(identifier, {"started": now.isoformat(timespec="microseconds"), **record})
    return identifier


def _record(scenarios: Sequence[Scenario], estimators: Mapping[str, Estimator], trials: int) -> dict[str, Any]:
    cells = [cell for scenario in scenarios for cell in cells_of(scenario, estimators)]
    return {
        "trials": trials,
        "scenarios": [describe(s) for s in scenarios],
        "estimators": {label: describe(e) for label, e in estimators.items()},
        "cells": [{"key": c.key, "identity_key": c.identity_key, "names": c.names} for c in cells],
        "libraries": library_versions(),
        "machine": {"host": platform.node(), "system": platform.platform(), "cores": cores()},
        "git_commit": _git_commit(Path.cwd()),
        **fingerprint([*scenarios, *estimators.values()]),
    }


@functools.cache
def _git_commit(folder: Path) -> str | None:
    """The commit of the folder, where it is in a repository; asked once per process, as a sweep records it per job."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
