"""Defines `ipe-bench run`: reads the words, checks every job, computes what is missing, and shows
the results."""

from __future__ import annotations

import functools
import re
import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import say
from ipe_bench.cli import words as w
from ipe_bench.cli.keys import OF_FILES, SETTING_NOTHING
from ipe_bench.cli.parser import COMMANDS, parser_of
from ipe_bench.cli.results import show_report
from ipe_bench.cli.session import Jobs, complete, jobs_of, session, show, spec_of
from ipe_bench.cli.single import require_one_kind
from ipe_bench.cli.spec import Spec
from ipe_bench.plugins.discovery import PACKAGES, options, read_yaml_file
from ipe_bench.plugins.standard import of_run
from ipe_bench.report.progress import watching
from ipe_bench.report.words import counted
from ipe_bench.runs.execution import Serial, end_idle
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import accept, compute, record_refusal, result_keys, validate
from ipe_bench.runs.store import describe_names

_NOT_TELLING = {*SETTING_NOTHING, *PACKAGES, "experiment"} - {"seed"}
"""Keys that do not distinguish the jobs of a sweep."""


@dataclass(frozen=True)
class Outcome:
    """Holds the result of one job: plain data, which launchers send back from other processes."""

    output: str
    words: tuple[str, ...] = ()
    """The overrides of the job."""
    cells: dict[str, str] = field(default_factory=dict)
    """Line of each requested result, by key."""
    failures: tuple[str, ...] = ()
    stop: str = ""
    """Number of trials of a job with a precision, and the reason for its end."""
    remarks: tuple[str, ...] = ()
    """Remarks of the model on itself."""
    precision_missed: bool = False
    """Whether the requested precision was missed."""
    objective: float | None = None
    mistake: str = ""

    @property
    def job(self) -> str:
        """Words that may tell the job from the others of a sweep, or the name of its folder."""
        words = [word.lstrip("+~").replace(w.HYDRAS_TRUTH, w.TRUTH) for word in self.words]
        telling = [word for word in words if re.split("[.=]", word)[0] not in _NOT_TELLING]
        return ", ".join(telling) or Path(self.output).name

    def label(self, command: str) -> str:
        """Returns the words that the sweep of a command gives to this job, or `job` where there is
        no sweep."""
        typed = {word.lstrip("+~") for word in shlex.split(command)}
        swept = tuple(word for word in self.words if word.lstrip("+~") not in typed)
        # Without a folder it has no name where no word of the sweep tells it.
        return replace(self, words=swept, output="").job or self.job

    def __float__(self) -> float:
        """Returns the objective of sweepers that optimise; they cannot go on from a job that was
        refused."""
        if self.mistake or self.objective is None:
            raise UserError(
                self.mistake or "objective: is not given; a sweeper that optimises needs it"
            )
        return self.objective


def run_command(arguments: Sequence[str]) -> int:
    """Computes and shows; exit code 1 where something failed or is missing."""
    flags = _flags(arguments)
    folder = None if flags.config_dir is None else Path(flags.config_dir)
    with session(folder, flags.config_name):
        if flags.shell_completion:
            complete(flags.overrides, COMMANDS)
            return 0
        typed = [*_rerun(flags.experimental_rerun), *flags.overrides]
        swept = [w.swept(word) for word in typed]
        words = _named(w.read("run", swept, folder))
        jobs = jobs_of(words, multirun=flags.multirun or swept != typed)
        if flags.cfg or flags.info or flags.hydra_help:
            show(words, flags)
            return 0
        jobs = _suited(words, jobs)
        if flags.dry_run:
            say(*_missing(jobs))
            return 0
        say(*_there_already(jobs))
        if words.standard_baselines:
            say(*_left_out(jobs.specs))
        command = shlex.join(["ipe-bench", "run", *arguments])
        task = Task(command, words.files, words.standard_baselines)
        outcomes = _computed_here(jobs, task) if jobs.told else _launched(jobs, task)
    return _conclude(jobs, outcomes)


def _named(words: w.Words) -> w.Words:
    """Adds the name that results have if none is given."""
    named = w.read("run", [f"default_name='{w.default_name(words)}'"])
    return replace(words, overrides=words.overrides + named.overrides)


def _suited(words: w.Words, jobs: Jobs) -> Jobs:
    """Refuses jobs whose words or parts do not go together, and leaves out standard baselines that
    do not suit a job."""
    words.refuse(OF_FILES, "is for `ipe-bench estimate`: run simulates its readings")
    require_one_kind(words, jobs.specs[0])
    if words.standard_baselines:
        jobs = replace(jobs, specs=[one.suited() for one in jobs.specs])
    for one in jobs.specs:
        _ = one.scenario  # whose parts may not suit one another
    return jobs


def _computed_here(jobs: Jobs, task: Task) -> list[Outcome]:
    """Returns the outcomes of jobs whose words are known, computed one after another."""
    stored = _Stored()
    for told, spec in zip(jobs.told, jobs.specs, strict=True):
        task.compute(told, spec, stored.of(spec))
    return task.outcomes


def _launched(jobs: Jobs, task: Task) -> list[Outcome]:
    """Returns the outcomes of jobs, run by the launcher and the sweeper that the words choose."""
    try:
        return jobs.launch(task) or task.outcomes
    except Exception:
        if jobs.optimises:  # a sweeper has words of its own for a job that gave it no number
            for outcome in task.outcomes:
                float(outcome)
        raise


def _read(output: str) -> Results:
    """Reads what a folder holds; nothing if it is not there yet."""
    return Results.read([output] if Path(output).is_dir() else [])


def _missing(jobs: Jobs) -> list[str]:
    """Lists what is stored of each job and what is missing, a line each, and the sums."""
    lines = []
    stored = 0
    missing = 0
    stored_of = functools.cache(_read)
    # The words of a job are not known where a sweeper of Hydra's chooses them.
    told_of = jobs.told or [jobs.words.text] * len(jobs.specs)
    for told, job in zip(told_of, jobs.specs, strict=True):
        validate([job.scenario], job.estimators, job.count, job.block_size)
        cells = result_keys(job.scenario, job.estimators)[1:]
        results = stored_of(job.output)
        lacking = 0
        for cell in cells:
            lacking += sum(stop - start for start, stop in results.missing(cell.key, job.count))
        asked = job.count * len(cells)
        most = "" if job.precision is None else "at most "
        more = f", {most}{lacking} are missing" if lacking else ""
        name = Outcome(job.output, w.as_typed(told, jobs.words.files)).job
        lines.append(f"{name}: {asked - lacking} of {asked} estimates are stored{more}")
        stored += asked - lacking
        missing += lacking
    return [
        *lines,
        f"{stored} estimates are stored, {missing} would be computed; none was computed now",
    ]


def _there_already(jobs: Jobs) -> list[str]:
    """Warns of each folder that holds results of other commands; refuses the name of another
    experiment."""
    lines = []
    outputs = [job.output for job in jobs.specs if job.write_readings is None]
    for output in dict.fromkeys(outputs):
        found = Results.read([output], keys=()).runs if (Path(output) / "runs").is_dir() else ()
        there: set[str] = set()
        for run in found:
            cells = [one for one in run["cells"] if one["names"]["estimator"] != TRUTH]
            there |= {one["identity_key"] for one in cells}
        for job in jobs.specs:
            there -= {cell.identity_key for cell in result_keys(job.scenario, job.estimators)}
        if there:
            held = f"{counted(len(there), 'result')} of other settings or older code"
            lines.append(f"{output}: contains {held}; they are kept")
    name = jobs.words.chosen("name")
    own = jobs.words.chosen("experiment")
    if name != own and name in [option.name for option in options("experiment")]:
        remedy = f"choose another, or write output=outputs/{name} in its place to mix them"
        raise UserError(
            f"name={name}: is the name of an experiment, whose results these would join; {remedy}"
        )
    return lines


def _left_out(jobs: Sequence[Spec]) -> list[str]:
    """Names the standard filters that do not suit every job."""
    standard = of_run("baseline")
    of_constants = [job for job in jobs if job.state_model is None]
    lacking = [job for job in of_constants if not job.estimators.keys() >= set(standard)]
    if not lacking:
        return []
    models = ", ".join(dict.fromkeys(job.measurement.name for job in lacking))
    left = [one for one in standard if any(one not in job.estimators for job in lacking)]
    return [f"{' and '.join(left)} are left out for {models}: filters need an order and a prior"]


def _flags(arguments: Sequence[str]) -> Namespace:
    flags = parser_of("run").parse(arguments)
    apart = ("multirun", "cfg", "info", "hydra_help", "shell_completion")
    asked = [f"--{name}" for name in apart if vars(flags)[name]]
    if len(asked) > 1:
        raise UserError(f"run: {' '.join(asked).replace('_', '-')}: do not go together; choose one")
    if flags.resolve and not flags.cfg:
        raise UserError("run: --resolve: goes with --cfg, such as --cfg job --resolve")
    if flags.config_dir is not None and not Path(flags.config_dir).is_dir():
        raise UserError(f"run: --config-dir={flags.config_dir}: there is no such folder")
    return flags


def _rerun(name: str | None) -> list[str]:
    """Reads the words of a job from the folder that Hydra left of it, or from a file in it."""
    if name is None:
        return []
    place = Path(name)
    folder = place if place.is_dir() else place.parent
    files = [folder / "overrides.yaml", folder / ".hydra" / "overrides.yaml"]
    for file in filter(Path.is_file, files):
        found = read_yaml_file(file, f"--experimental-rerun={name}")
        if isinstance(found, list):
            return [str(word) for word in found]
    raise UserError(
        f"run: --experimental-rerun={name}: there is no overrides.yaml; name the folder .hydra of a"
        " job"
    )


@dataclass(frozen=True)
class Task:
    """Computes jobs; a mistake in one stops no other."""

    command: str
    """Command as it was typed."""
    files: Mapping[str, str]
    """Word that names the file, by an override that it holds."""
    standard: bool
    """Whether the baselines are those of a plain run."""
    outcomes: list[Outcome] = field(default_factory=list)
    """Outcomes of the jobs in this process: a sweeper that optimises keeps to itself what they
    return."""

    def __call__(self, config: DictConfig) -> Outcome:
        """Computes a job that Hydra has composed and launched."""
        hydra = HydraConfig.get()
        # Where a launcher plugin (joblib, submitit) runs the jobs, the cores are its to share out.
        ours = hydra.launcher["_target_"].endswith(".BasicLauncher")
        words = hydra.overrides.task
        try:
            spec = spec_of(config)
        except UserError as error:
            refused = Outcome(str(config.output), tuple(words), mistake=str(error))
            self.outcomes.append(refused)
            return refused
        if self.standard:
            spec = spec.suited()
        if hydra.mode == RunMode.MULTIRUN and not ours:
            spec = replace(spec, execution=Serial())
        return self.compute(words, spec)

    def compute(self, words: Sequence[str], spec: Spec, known: Results | None = None) -> Outcome:
        """Computes a job; `known` is what was read of its results before."""
        done = Outcome(spec.output, w.as_typed(words, self.files))
        try:
            done = _computed(spec, done, self.command, known)
            accept(done.output, done.job)
        except UserError as error:
            done = replace(done, mistake=str(error))
        self.outcomes.append(done)
        return done


class _Stored:
    """Holds what the folders of a sweep had before it, each read once."""

    def __init__(self) -> None:
        self.read = functools.cache(_read)
        self.changed: set[str] = set()

    def of(self, job: Spec) -> Results | None:
        """Returns what was read of a job's results; None if a job before it added to them."""
        keys = {cell.key for cell in result_keys(job.scenario, job.estimators)}
        known = self.read(job.output)
        shared = not self.changed.isdisjoint(keys)
        self.changed |= {key for key in keys if job.precision or known.missing(key, job.count)}
        return None if shared or job.precision else known


def _computed(job: Spec, begun: Outcome, command: str, known: Results | None) -> Outcome:
    """Computes the trials that are asked for, or just enough."""
    if job.write_readings is not None:
        write_trial(job, Path(job.write_readings), job.write_readings_trial)
        return begun
    if job.state_model is None:
        remarks = job.measurement.remarks(job.measurement.nominal)
    else:
        remarks = job.state_model.remarks()
    done = replace(begun, remarks=remarks)
    asked: Any = ([job.scenario], job.estimators, job.count, job.output)
    with watching(begun.label(command), lines=True) as watch:
        options: dict[str, Any] = {
            "execution": job.execution,
            "block_size": job.block_size,
            "command": command,
            "watch": watch,
        }
        if job.precision is None:
            done = replace(done, failures=compute(*asked, **options, known=known))
        else:
            done = _until_precise(job, done, asked, options)
    if job.objective is not None:
        from ipe_bench.statistics.stopping import objective

        value = objective(job.scenario, job.estimators, *job.aim, job.output)
        done = replace(done, objective=value)
    keys = result_keys(job.scenario, job.estimators)
    return replace(done, cells={one.key: describe_names(one.names) for one in keys})


def _until_precise(job: Spec, begun: Outcome, asked: Any, options: Mapping[str, Any]) -> Outcome:
    """Computes as many trials as the precision of a job needs, and says where it ended."""
    from ipe_bench.statistics.stopping import NARROW, compute_until

    failures, (stop,) = compute_until(
        *asked, **options, precision=job.precision, time_limit=job.time_limit
    )
    missed = stop["reason"] != NARROW
    verdict = "the precision is not reached: " if missed else ""
    said = f"{begun.job}: {stop['trials']} trials; {verdict}{stop['reason']} ({stop['widest']})"
    return replace(begun, failures=failures, stop=said, precision_missed=missed)


def _conclude(jobs: Jobs, outcomes: list[Outcome]) -> int:
    """Shows the outcomes of the jobs; returns the exit code."""
    end_idle()  # a report on many trials has use for their memory
    failed = any(one.failures or one.precision_missed for one in outcomes)
    code = 1 if failed else 0
    if jobs.specs[0].write_readings is None:
        if jobs.multirun:
            _record_refusals(jobs, outcomes)
        code = max(code, _show_reports(jobs, outcomes))
    refused = [one for one in outcomes if one.mistake]
    remarks = [remark for one in outcomes for remark in one.remarks]
    say(*dict.fromkeys(f"Note: {remark}" for remark in remarks))
    say(*_best(outcomes, jobs.maximises), *(one.stop for one in outcomes if one.stop))
    if refused:
        raise UserError(_refused(refused, told=jobs.multirun and len(outcomes) > 1))
    return code


def _record_refusals(jobs: Jobs, outcomes: Sequence[Outcome]) -> None:
    """Records which jobs were refused, so that reports say what is missing."""
    known = jobs.specs if len(jobs.specs) == len(outcomes) else [None] * len(outcomes)
    for one, spec in zip(outcomes, known, strict=True):
        if one.mistake:
            parts: Any = () if spec is None else (spec.scenario, spec.estimators, spec.count)
            record_refusal(one.output, one.job, one.mistake, *parts)


def _show_reports(jobs: Jobs, outcomes: Sequence[Outcome]) -> int:
    """Shows the report of each folder that has results; returns the largest exit code."""
    first = jobs.specs[0]
    cells: dict[str, dict[str, str]] = {}
    # Of jobs that a sweeper ran in other processes nothing is known but the folder.
    for one in outcomes or [Outcome(job.output) for job in jobs.specs]:
        cells.setdefault(one.output, {}).update(one.cells)
    code = 0
    for output, of_folder in cells.items():
        folder = Path(output)
        if (folder / "trials").is_dir():
            shown = show_report([folder], folder, first.figures, first.formats, of_folder)
            code = max(code, shown)
    return code


def _refused(outcomes: Sequence[Outcome], *, told: bool) -> str:
    """Says why jobs were refused, and which if there are several."""
    which: dict[str, list[str]] = {}
    for one in outcomes:
        which.setdefault(one.mistake, []).append(one.job)
    if not told:
        return "; ".join(which)
    reasons = []
    for reason, jobs in which.items():
        more = f" and {len(jobs) - 1} more" if len(jobs) > 1 else ""
        reasons.append(f"{reason} (refused: {jobs[0]}{more})")
    return "; ".join(reasons)


def _best(outcomes: Sequence[Outcome], maximises: bool) -> list[str]:
    """Names the best job in a line, with its words that not all jobs have; empty if no job has an
    objective."""
    known = [one for one in outcomes if one.objective is not None and not one.mistake]
    if not known:
        return []
    best = (max if maximises else min)(known, key=float)
    line = f"Objective {float(best):.6g}"
    if len(known) > 1:
        extreme = "greatest" if maximises else "least"
        line += f", the {extreme} of {len(known)} jobs"
    common = set.intersection(*(set(one.words) for one in known))
    own = " ".join(word.lstrip("+") for word in best.words if word not in common)
    return [f"{line}: {own}" if own else line]


def write_trial(job: Spec, path: Path, trial: int) -> None:
    """Writes the simulated readings of one trial, and its true parameters beside them."""
    from ipe_bench.real.readings import write_readings, write_truth

    drawn = job.scenario.draw(trial, trial + 1)
    model = job.scenario.measurement
    truth = path.with_name(f"{path.stem}.truth.csv")
    if truth.exists():
        raise UserError(
            f"{truth}: is there already and is not overwritten; name another file or remove it"
        )
    write_readings(path, model, drawn.z[0])
    write_truth(truth, model, drawn.x[0])
    print(f"Readings of trial {trial}: {path}\nTrue parameters:     {truth}")
