"""Offers the whole bench as functions, by which the command line does its work. They know no
Hydra."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from ipe_bench.basics.definitions import renewed
from ipe_bench.basics.errors import UserError, refuse_unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.base import Measurement
from ipe_bench.noise.base import Noise
from ipe_bench.priors import Prior
from ipe_bench.runs.execution import Execution
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import validate
from ipe_bench.runs.schedule import Watcher
from ipe_bench.runs.store import require_results
from ipe_bench.states.base import StateModel
from ipe_bench.states.trackers import Tracker
from ipe_bench.trials.paths import AnyScenario, StateScenario
from ipe_bench.trials.scenario import Scenario

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.questions.audit.answer import AuditAnswer
    from ipe_bench.questions.compare.answer import Comparison
    from ipe_bench.questions.design.maths import Criterion, Design
    from ipe_bench.questions.posterior.maths import Reference
    from ipe_bench.report.page.answer import Answer
    from ipe_bench.report.page.log import LogAnswer
    from ipe_bench.report.page.run import ReportResult
    from ipe_bench.report.progress import Shows
    from ipe_bench.report.style import Which
    from ipe_bench.report.summary import Summary
    from ipe_bench.workshop.conformance import Finding

Directories = Path | str | Sequence[Path | str]
Simulated = AnyScenario | Measurement | StateModel
RealReadings = Path | str | Sequence[Path | str] | Array | None


def run(
    scenarios: Simulated | Sequence[Simulated],
    estimators: Mapping[str, Any],
    trials: int | None = None,
    *,
    noise: Noise | None = None,
    prior: Prior | None = None,
    error_scale: float | None = None,
    seed: int | None = None,
    precision: float | None = None,
    time_limit: float | None = None,
    output: Path | str | None = None,
    execution: Execution | None = None,
    block_size: int | None = None,
    watch: Watcher | None = None,
    progress: bool = True,
) -> Summary:
    """Runs every estimator on the same trials of every scenario, and summarises what is known of
    them.

    Parameters:
        scenarios: one or several. A measurement with its `noise`, `prior` and `error_scale` stands
            for a scenario, a state model for its `StateScenario`, whose estimators are trackers.
        estimators: by label.
        seed: number that all draws follow from; that of each scenario unless given.
        trials: of each scenario, 1000 unless given; with `precision` the most, 100,000 unless
            given.
        precision: such as 0.01: trials are added until the intervals of success are that narrow.
        time_limit: seconds after which no more blocks are added.
        output: folder of the results; what it has is not computed again. None: nothing is kept.
        execution, block_size: where trials are computed, and how many in a block.
        progress: whether a terminal or a notebook shows how far the run is.
        watch: called at each event in place of that; its argument has the `trials` of the `total`
            that are done, where each estimator's count as its own.

    Returns:
        A frame with a row per scenario, estimator and parameter, in the parameter's own unit, and
        one of the parameter `all`, the root mean square over parameters of error over bound. It
        shows the table of the terminal; `.trials` has a row per trial, `.figures` Matplotlib's
        figures by name, and `.report(output)` writes the report. With `precision`, `attrs["stops"]`
        has trials and reason of each scenario. Warnings name what was not computed.

    Raises:
        UserError: what was asked for cannot be computed; nothing has been computed then.

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> both = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}
    >>> table = ib.run(bench, both, trials=20)
    >>> table[table["parameter"] == "all"].set_index("estimator")["converged"].to_dict()
    {'newton': 1.0, 'linear': 1.0}
    >>> table = ib.run(bench, {"newton": ib.solvers.Newton()}, precision=0.05)
    >>> [(stop["trials"], stop["reason"]) for stop in table.attrs["stops"]]
    [(250, 'every interval is narrow enough')]
    """
    from ipe_bench.plugins.extensions import use_statistics
    from ipe_bench.report.progress import watching
    from ipe_bench.report.summary import Stored, Summary
    from ipe_bench.statistics import summarize
    from ipe_bench.statistics.stopping import compute_until

    stated = {"noise": noise, "prior": prior, "error_scale": error_scale}
    _require_whole(trials=trials, block_size=block_size)
    several = scenarios if isinstance(scenarios, Sequence) else [scenarios]
    scenarios = [_tracking(one, **stated) or _scenario(one, **stated) for one in several]
    if seed is not None:
        scenarios = [dataclasses.replace(one, seed=seed) for one in scenarios]
    estimators = _labelled(estimators)
    stored = Stored(output)
    options: dict[str, Any] = {"execution": execution, "block_size": block_size}
    options |= {"precision": precision, "time_limit": time_limit}
    with watching("run", off=watch is not None or not progress) as shown:
        asked: Any = scenarios, estimators, trials, stored.folder
        failures, stops = compute_until(*asked, **options, watch=watch or shown)
    _warn([*(f"failed: {failure}" for failure in failures), *use_statistics()])
    table = Summary.of(summarize([stored.folder]), stored)
    if precision is not None:
        table.attrs["stops"] = stops
    return table


def load(directories: Directories) -> pd.DataFrame:
    """Reads every stored trial of one directory, or of several.

    Returns:
        A row per trial and estimator: measurement, noise, prior, error_scale, seed, estimator, and
        every key of the config that differs; trial, status, success, solved, `error_NAME`,
        `crlb_distance` (the squared Mahalanobis distance by the bound at the truth, of a scalar
        state of a curved model by its exact posterior), nees, fit_p, iterations, simulations,
        jacobians, time_s, message, the truth `x_NAME`, `deviation_NAME` as the estimator reports
        it, the bounds `crlb_NAME` and `bayes_NAME`, in multiples of the parameters' sizes; columns
        that only some rows have come last. A warning names what is missing or damaged; stale
        results are left out.

    >>> import tempfile, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> both = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ib.run(bench, both, 20, output=folder)
    ...     rows = ib.load(folder)
    >>> rows.groupby("estimator", sort=False)["trial"].count().to_dict()
    {'newton': 20, 'linear': 20}
    >>> rows["measurement"].unique().tolist(), bool((rows["x_c0"] + rows["error_c0"]).notna().all())
    (['polynomial'], True)
    """
    from ipe_bench.statistics.collect import collect, trials_frame

    collection = collect(require_results(_paths(directories)))
    frame = trials_frame(collection)
    _warn(collection.problems)
    return frame


def report(
    directories: Directories,
    output: Path | str | None = None,
    *,
    figures: Which = "main",
    formats: str | Sequence[str] = "png",
) -> ReportResult:
    """Writes summary.csv, tables/, figures/ and report.html from what is stored.

    Parameters:
        output: folder of the report; the first directory unless given.
        figures: all that the data allow, main (the few that answer the question) or none.
        formats: beside PNG and CSV, such as "pdf" or ["pdf", "svg", "md", "tex"].

    Returns:
        The names of the files, the summary and the problems.

    >>> import ipe_bench as ib
    >>> ib.report("outputs/nowhere")
    Traceback (most recent call last):
    ipe_bench.basics.errors.UserError: outputs/nowhere: there is no such folder; give the output ...
    """
    from ipe_bench.report.page.run import begin_report

    paths = _paths(directories)
    require_results(paths)
    return begin_report(paths, output, figures=figures, formats=formats).written()


def compare(
    first_directory: Directories,
    second_directory: Directories | None = None,
    *,
    first: str | None = None,
    second: str | None = None,
    alpha: float = 0.05,
    anytime: bool = False,
    fail_on: Sequence[str] | None = None,
    margins: Mapping[str, float] | None = None,
    complete: bool = False,
    power: float | None = None,
    difference: float | None = None,
    output: Path | str | None = None,
) -> Comparison:
    """Tests whether a second version, setting or estimator is better or worse than a first, trial
    by trial.

    Parameters:
        first_directory, second_directory: whose estimators and scenarios are compared, if both have
            them, on trials matched by seed and number, else in their order; without a second both
            versions are in the first.
        first, second: labels, if one estimator is compared with another.
        alpha: error probability below which a finding is made, of `p` corrected over all tests
            (Holm).
        anytime: findings are made by `e`, evidence that may be looked at after any number of
            trials.
        fail_on: quantities that are tested, and listed in `attrs["worse"]` if they get worse:
            success, error, cost, honesty (ratio of mean squared errors over claimed variances,
            worse farther from 1), bias of each parameter (difference of mean errors in deviations
            of the bound, worse farther from 0). Unless given: success, error.
        margins: changes that matter, by quantity; the interval of a finding lies beyond.
        complete: what the second lacks of the first is among the problems.
        power, difference: `trials_needed` find such a difference of success with that probability.
        output: folder for comparison.csv and a page.

    Returns:
        A row per comparison and quantity: success (a difference of shares), error (a ratio of mean
        Mahalanobis errors, each at most the radius of the gate), cost in simulations (a ratio), and
        time, which is not tested. `low` and `high` are the ends of the row's own interval,
        `finding` says what the second is. `attrs` has lines on what is `worse`, on `problems`,
        `stale` results and `notes`.

    >>> import tempfile, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> both = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ib.run(bench, both, 20, output=folder)
    ...     rows = ib.compare(folder, first="linear", second="newton")
    >>> rows.set_index("quantity")["finding"].to_dict()
    {'success': 'better', 'error': 'better', 'cost': 'worse', 'time': ''}
    """
    from ipe_bench.questions.compare.answer import compared_folders

    return compared_folders(
        _paths(first_directory),
        None if second_directory is None else _paths(second_directory),
        first=first,
        second=second,
        alpha=alpha,
        anytime=anytime,
        fail_on=fail_on,
        margins=margins,
        complete=complete,
        power=power,
        difference=difference,
        output=output,
    )


def audit(table: Path | str | pd.DataFrame, *, output: Path | str | None = None) -> AuditAnswer:
    """Tests whether the covariance that another program reports describes its errors.

    Parameters:
        table: a CSV or Parquet file, or a frame, with a row per run: NAME_true and NAME (or
            NAME_error), NAME_std (or NAME_var), and cov_A_B as far as there are any; see
            `ipe_bench.questions.audit.maths.read_claims`.
        output: folder for audit.csv and audit.html.

    Returns:
        An audit: at most three `sentences`, the strongest first; `verdict` on the covariance, "too
        small", "too large", "right" or "undecided"; `scale`, true errors over reported standard
        deviations, with an interval that needs no normal law; and `table()`, the same for each
        parameter.

    >>> import numpy as np, pandas as pd, ipe_bench as ib
    >>> error = np.random.default_rng(0).normal(0, 0.3, 200)
    >>> found = ib.audit(pd.DataFrame({"x_error": error, "x_std": 0.1}))
    >>> found.verdict, round(found.scale.value, 1)
    ('too small', 2.9)
    """
    from ipe_bench.questions.audit.answer import audited

    return audited(table, output)


def status(directories: Directories) -> pd.DataFrame:
    """Counts the trials that runs asked for.

    Returns:
        A row per scenario and estimator (`truth`: the truth and its bounds), with the numbers of
        trials `expected`, `done`, `missing`, `failed` and `stale`, and `messages`, why trials
        failed. `attrs["problems"]` has a line for everything that is missing, failed or damaged.

    >>> import tempfile, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ib.run(bench, {"newton": ib.solvers.Newton()}, trials=20, output=folder)
    ...     table = ib.status(folder)
    >>> table[["estimator", "expected", "done"]].values.tolist(), table.attrs["problems"]
    ([['truth', 20, 20], ['newton', 20, 20]], [])
    """
    import pandas as pd

    results = Results.read(require_results(_paths(directories)))
    counts = ("expected", "done", "missing", "failed", "stale")
    rows = [
        {**cell.names, **{name: getattr(cell, name) for name in counts}} for cell in results.cells
    ]
    frame = pd.DataFrame(rows).assign(messages=["; ".join(cell.messages) for cell in results.cells])
    frame.attrs["problems"] = results.problems
    return frame


@overload
def estimate(
    model: StateModel,
    readings: RealReadings = None,
    estimators: Mapping[str, Tracker] | None = None,
    *,
    ignore_columns: Sequence[str] = (),
    find: str | Sequence[str] = (),
    progress: Shows = True,
) -> LogAnswer: ...


@overload
def estimate(
    model: Measurement | Scenario,
    readings: RealReadings = None,
    estimators: Mapping[str, Estimator] | None = None,
    *,
    noise: Noise | None = None,
    prior: Prior | None = None,
    error_scale: float | None = None,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    ignore_columns: Sequence[str] = (),
    examine: bool = True,
    progress: Shows = True,
) -> Answer: ...


def estimate(
    model: Measurement | Scenario | StateModel,
    readings: RealReadings = None,
    estimators: Mapping[str, Any] | None = None,
    *,
    noise: Noise | None = None,
    prior: Prior | None = None,
    error_scale: float | None = None,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    ignore_columns: Sequence[str] = (),
    find: str | Sequence[str] = (),
    examine: bool = True,
    progress: Shows = True,
) -> Answer | LogAnswer | list[LogAnswer]:
    """Estimates parameters from real readings by every estimator, with standard errors, residuals
    and a test of fit.

    Parameters:
        model: or a scenario, which states `noise`, `prior`, `error_scale`; or a state model, which
            takes none.
        readings: a CSV or Parquet file, several that share parameters, or an array z (m,) in the
            model's order and unit, NaN if missing; None: those of the model. Of a state model a
            log, a row per epoch, or (K, m), or several that are independent.
        estimators: by label; of a state model trackers. None: a few that suit most models.
        noise: states R. None: R is that of the file's column sigma, or of the model's own noise, or
            else one level is estimated from the residuals (`Unknown`), whose size then cannot test
            the fit.
        prior, error_scale: of filters and `map_lm`: deviations of `error_scale` sizes, which
            `prior` widens or narrows.
        parameters: as {"k": {"fixed": 2.0}, "c": {"positive": True, "nominal": 3.0}}; also lower,
            upper, deviation.
        ignore_columns: columns of the files that are left out.
        find: constants, noises or readings of a state model by formulas, found as `constants` by
            largest likelihood.
        examine: whether further starts look for a lower minimum, and its intervals are computed;
            without that one fit of few readings takes a few milliseconds, as loops over many data
            sets need.
        progress: whether a terminal or a notebook shows what is at work; "lines" prints a line now
            and then elsewhere.

    Returns:
        The sequence of the fits, each with its estimates by name in `values`, and `x` and
        `covariance` in the parameters' own units; of a state model a track of each (see
        `ipe_bench.real.logs`), and of several logs a list of these. It shows itself in a notebook,
        and `table()` is a frame.

    Raises:
        UserError: the readings are not this model's, or an estimator needs what is not given.

    >>> import ipe_bench as ib
    >>> model = ib.measurements.Polynomial()
    >>> trial = ib.Scenario(model, ib.noise.Gaussian(0.01), error_scale=3.0).draw(0, 1)
    >>> for fit in ib.estimate(model, trial.z[0], noise=ib.noise.Gaussian(0.01)):
    ...     print(fit.label, fit.status.label, fit.fits)
    auto converged True
    linear_lse converged False
    levenberg_marquardt converged True
    """
    from ipe_bench.plugins import standard
    from ipe_bench.plugins.construct import known_parameters
    from ipe_bench.real.estimation import Question
    from ipe_bench.report.page.answer import Answer

    _refuse_table(readings)
    model = renewed(model)  # as in `_scenario`
    if isinstance(model, StateModel):
        stated = {
            "noise": noise,
            "prior": prior,
            "error_scale": error_scale,
            "parameters": parameters,
        }
        for name, value in stated.items():
            if value is not None:
                raise UserError(
                    f"{name}=: is of a measurement, and this is a model of states that move; leave"
                    " it out"
                )
        return _tracked(model, readings, estimators, ignore_columns, find, progress)
    if find:
        raise UserError(
            "find=: is for models of states that move; all parameters of a measurement are found"
        )
    if not isinstance(model, Measurement):
        scenario = _scenario(model, noise=noise, prior=prior, error_scale=error_scale)
        model = scenario.measurement
        noise = None if scenario.noise.real else scenario.noise
        prior = scenario.prior
        error_scale = scenario.error_scale
    if estimators is None:
        estimators = standard.constructed(standard.OF_ESTIMATE)
    estimators = _labelled(estimators, Estimator)
    stated: dict[str, Any] = {"noise": noise, "prior": prior, "error_scale": error_scale}
    stated |= {"known": known_parameters(parameters or {}), "ignored": tuple(ignore_columns)}
    question = Question(
        model=model, readings=_given(readings), estimators=estimators, **stated
    ).checked()
    return Answer.to(question, progress=progress, examine=examine)


def _tracked(
    model: StateModel,
    readings: Any,
    trackers: Mapping[str, Any] | None,
    ignored: Sequence[str],
    find: str | Sequence[str],
    progress: Shows,
) -> LogAnswer | list[LogAnswer]:
    from ipe_bench.plugins import standard
    from ipe_bench.real.logs import LogQuestion
    from ipe_bench.report.page.log import LogAnswer

    if trackers is None:
        choice = standard.OF_FILTERS if find else {"tracker": standard.of_run("tracker")}
        trackers = standard.constructed(choice)
    question = LogQuestion.of(model, readings, _labelled(trackers), ignored, find)
    answers = LogAnswer.to(question, progress)
    return answers[0] if len(answers) == 1 else answers


def design(
    scenario: Scenario | Measurement,
    *,
    noise: Noise | None = None,
    prior: Prior | None = None,
    error_scale: float | None = None,
    at: Mapping[str, float] | None = None,
    by: Sequence[str] | None = None,
    readings: int | None = None,
    criterion: Criterion = "A",
    errors: Sequence[Measurement] | None = None,
) -> Design:
    """Evaluates, without simulation, what a scenario's readings say about each parameter, and which
    would say more.

    Parameters:
        scenario: or a measurement, with its `noise`, `prior` and `error_scale`.
        at: estimates by name, such as `fit.values`, at which all is evaluated; None: the model's
            start, and truths from the prior.
        by: columns of the model's index by which the one way chooses; None: ways by each column,
            and by reading.
        readings: number that the sharpest choice has; None: as many as today.
        criterion: of choices, the bounds as shares of today's, averaged over start and truths: as
            squares over parameters (A), or as the volume of the ellipsoid (D).
        errors: richer models; None: the truth, or every option of `measurement` that is the model
            with more errors.

    Returns:
        A design with `observability` (singular values, bounds, correlations, the least observable
        direction), `suspects` (what each error of the richer models does to the estimates, and
        whether a test of residuals will notice) and `ways`. Of a way, `saving` has the fewest
        readings whose mean bound is not above today's, `sharpest` the smallest mean bound;
        `measurement(choice)` is the model of a choice.

    Raises:
        UserError: the errors of readings are correlated, a column is unknown, or there are too few
            readings.

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> found = ib.design(bench, readings=20)
    >>> half = found.ways[-1].sharpest
    >>> half.readings, bench.measurement.m, half.mean_bound < 2**0.5
    (20, 40, True)
    >>> ib.Scenario(found.measurement(half), bench.noise, error_scale=3.0).draw(0, 5).z.shape
    (5, 20)
    """
    from ipe_bench.questions.design.answer import designed

    scenario = _scenario(scenario, noise=noise, prior=prior, error_scale=error_scale)
    return designed(scenario, at=at, by=by, readings=readings, criterion=criterion, errors=errors)


def posterior(
    scenario: Scenario | Measurement,
    estimators: Mapping[str, Estimator],
    trials: int = 3,
    *,
    noise: Noise | None = None,
    prior: Prior | None = None,
    error_scale: float | None = None,
    particles: int = 1000,
    watch: Callable[[int], None] | None = None,
) -> list[Reference]:
    """Samples the posterior of a scenario's first trials, and measures how far each estimator's
    Gaussian is from it.

    Parameters:
        scenario: or a measurement, with its `noise`, `prior` and `error_scale`; errors are taken as
            N(0, R).
        particles: number of each of two populations that sequential Monte Carlo takes to the
            posterior.
        watch: called with the number of each trial before that is sampled.

    Returns:
        Of each trial the `truth` (n,), the `posterior` (draws `x` (draws, n) in multiples of the
        parameters' sizes, `mean`, `covariance`, `modes` with their `shares`, and whether it has
        `settled`: two populations agree), and by label `estimates` and `divergences`, which have
        `kl` in nats, `shift`, `width` and `energy`.

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> both = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}
    >>> (found,) = ib.posterior(bench, both, trials=1)
    >>> found.posterior.settled, len(found.posterior.modes)
    (True, 1)
    >>> found.divergences["newton"].kl < 1 < found.divergences["linear"].kl
    True
    """
    from ipe_bench.questions.posterior.answer import sampled

    scenario = _scenario(scenario, noise=noise, prior=prior, error_scale=error_scale)
    estimators = _labelled(estimators)
    validate([scenario], estimators, trials)
    return sampled(scenario, estimators, trials, particles, watch)


def component(name: str, **options: Any) -> Any:
    """Constructs what the command line calls GROUP=NAME: a model, noise, estimator or tracker.

    Parameters:
        name: GROUP/NAME, one of those that `ipe-bench list` shows, of plugins too.
        options: values in place of those of its config; a mapping changes the keys that it has.

    Raises:
        UserError: there is no such option, or a value does not suit.

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=50, start={"angle": 1.0})
    >>> model.epochs, model.start
    (50, {'angle': 1.0, 'rate': 0.0})
    >>> ib.component("tracker/ekf") == ib.states.ekf()
    True
    """
    from ipe_bench.plugins.construct import construct
    from ipe_bench.plugins.discovery import composed, merged
    from ipe_bench.plugins.discovery import options as offered

    known = {f"{one.group}/{one.name}": one for one in offered()}
    refuse_unknown(name, name, known, "option")
    return construct(merged(composed(known[name]), options), name.replace("/", "."))


def check(component: Any) -> list[Finding]:
    """Checks that a component, or each option of the plugin in a folder, keeps the promises of its
    kind.

    Returns:
        A finding per check; one whose `complaint` is empty passed, or did not apply, which its
        `note` says.

    >>> import ipe_bench as ib
    >>> findings = ib.check(ib.noise.Gaussian(0.1))
    >>> [f.check for f in findings if f.complaint]
    []
    """
    from ipe_bench.workshop.check import findings

    return findings(component)


def _scenario(given: Any, **stated: Any) -> Scenario:
    """Returns the given scenario, or that of a model with the stated noise, prior and error
    scale."""
    # A cell can have changed a function that its model was recorded with.
    given = renewed(given)
    stated = {name: value for name, value in stated.items() if value is not None}
    if isinstance(given, Scenario):
        if stated:
            raise UserError(
                f"{next(iter(stated))}=: is part of the scenario; leave it out, or give the model"
                " alone"
            )
        return given
    if not isinstance(given, Measurement):
        raise UserError(
            f"{_described(given)}; give a scenario, ib.Scenario(model, noise), or a measurement"
            " model"
        )
    return Scenario(given, **stated)


def _tracking(given: Any, **stated: Any) -> StateScenario | None:
    """Returns the scenario of a state model under what is stated of it; None for one of
    constants."""
    stated = {name: value for name, value in stated.items() if value is not None}
    if not isinstance(given, StateModel | StateScenario):
        return None
    for name in stated:
        if name != "error_scale" or isinstance(given, StateScenario):
            raise UserError(f"{name}=: is part of the state model or its scenario; leave it out")
    return given if isinstance(given, StateScenario) else StateScenario(given, **stated)


def _labelled(estimators: Any, kind: Any = Estimator | Tracker) -> Mapping[str, Any]:
    """Returns the estimators, if each has a label and is one."""
    if not isinstance(estimators, Mapping):
        raise UserError('estimators: give each a label, as in {"newton": ib.solvers.Newton()}')
    for label, one in estimators.items():
        if not isinstance(one, kind):
            raise UserError(
                f"estimators: {label}: {_described(one)}; give an estimator such as"
                " ib.solvers.Newton()"
            )
    return estimators


def _described(given: Any) -> str:
    """Describes the value that was given in place of an object of the bench."""
    if isinstance(given, type):
        return f"{given.__name__} is a class, whose objects are written {given.__name__}()"
    return f"{given!r:.60} is a {type(given).__name__}"


def _paths(directories: Directories) -> list[Path]:
    several = [directories] if isinstance(directories, Path | str) else directories
    return [Path(directory) for directory in several]


def _given(readings: Any) -> tuple[Path, ...] | Array | None:
    """Returns files as their paths, and numbers as an array."""
    if readings is None or isinstance(readings, np.ndarray):
        return readings
    several = [readings] if isinstance(readings, Path | str) else list(readings)
    if all(isinstance(one, Path | str) for one in several):
        return tuple(map(Path, several))
    return np.asarray(several)


def _refuse_table(readings: Any) -> None:
    if isinstance(readings, Mapping) or hasattr(readings, "columns"):
        names = ", ".join(map(str, getattr(readings, "columns", readings)))
        raise UserError(
            f"readings=: is a table of {names}; write it to a file with"
            " frame.to_csv('my.csv', index=False), and give readings='my.csv'"
        )


def _require_whole(**numbers: Any) -> None:
    for name, value in numbers.items():
        if value is not None and not isinstance(value, int | np.integer):
            raise UserError(f"{name}={value!r}: give a whole number")


def _warn(problems: Iterable[str]) -> None:
    for problem in problems:
        warnings.warn(problem, stacklevel=3)
