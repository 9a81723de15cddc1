"""`ipe-bench run`: composes the config with Hydra, computes what is missing, and shows what is known."""

from __future__ import annotations

import contextlib
import errno
import os
import shlex
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl as ConfigLoader
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import MissingConfigException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ipe_bench.basics.errors import StorageError, UserError, shortened
from ipe_bench.cli import console, interrupts
from ipe_bench.cli.config import CONFIG_ERRORS, assemble, explain, prepare, rewrite
from ipe_bench.cli.dry_run import DryRun
from ipe_bench.cli.flags import flags_of_hydra
from ipe_bench.cli.overrides import default_name, known_options, read
from ipe_bench.cli.parser import INFO_TOPICS, parsers
from ipe_bench.cli.progress import shown_progress
from ipe_bench.cli.report import main as report
from ipe_bench.cli.report import show_command
from ipe_bench.cli.spec import KEYS, Spec
from ipe_bench.cli.typed import check_options
from ipe_bench.measurements import Nist
from ipe_bench.plugins import discovery as plugins
from ipe_bench.report.choice import PAGE, Which, file_formats, which_figures
from ipe_bench.runs.execution import Execution, Serial
from ipe_bench.runs.execution.processes import end_idle
from ipe_bench.runs.provenance import digest
from ipe_bench.runs.run import accept, compute, record_refusal, result_keys
from ipe_bench.runs.schedule import Watcher
from ipe_bench.runs.store import describe_names

_OWN_LAUNCHER = ".BasicLauncher"
_KEPT_CONFIGS = 100
"""Of a large sweep all together would need more memory than its trials."""


class Outcome:
    """What the jobs of this invocation came to; Hydra hands nothing back from a sweep."""

    def __init__(self) -> None:
        self.started = False
        self.command: str | None = None
        """As it was typed; not known to jobs in other processes."""
        self.multirun = False
        self.elsewhere = False
        """Jobs run in other processes, from which nothing but an exception or a file comes back."""
        self.jobs = 0
        self.outputs: dict[Path, dict[str, str]] = {}
        """The folders that were filled, and by key a line for each cell that was asked for."""
        self.figures: Which = "main"
        self.formats: tuple[str, ...] = (PAGE,)
        self.failures: list[str] = []
        self.stops: list[str] = []
        """How many trials each job with a precision took, and why no more."""
        self.short = False
        """Some job did not come to its precision."""
        self.maximises = False
        self.objectives: list[tuple[float, list[str]]] = []
        """What each job came to in the column that is asked for, and what was asked of it."""
        self.dry: DryRun | None = None
        """What would be done, where nothing is to be."""
        self.mistakes: dict[str, list[str]] = {}
        """Why jobs were refused, and which."""
        self.refusals: list[tuple[Path, str, str, Spec | None]] = []
        """What is noted of it in the folders of a sweep."""
        self.bug: Exception | None = None
        self.storage: StorageError | None = None
        """Nothing can be stored any more: the remaining jobs are not begun."""

    def shown_objective(self) -> str:
        """The best job in a line, with those of its words that not all jobs have."""
        value, words = (max if self.maximises else min)(self.objectives, key=lambda known: known[0])
        common = set.intersection(*(set(other) for _, other in self.objectives))
        own = " ".join(word for word in words if word not in common)
        count = len(self.objectives)
        of = f", the {'greatest' if self.maximises else 'least'} of {count} jobs" if count > 1 else ""
        return f"Objective {value:.6g}{of}" + (own and f": {own}")


_outcome = Outcome()


class Watch(Callback):
    """Learns from Hydra which folder is being filled, also when a launcher runs the jobs elsewhere."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        _outcome.started = True

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        _outcome.started = _outcome.multirun = True
        _outcome.maximises = "maximize" in str(config.hydra.sweeper.get("direction", ""))
        _outcome.elsewhere = not config.hydra.launcher["_target_"].endswith(_OWN_LAUNCHER)
        output = OmegaConf.select(config, "output")
        _outcome.figures = which_figures(OmegaConf.select(config, "figures"))
        _outcome.formats = file_formats(OmegaConf.select(config, "formats"))
        if output is not None:
            _outcome.outputs[Path(output)] = {}

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        _outcome.jobs += 1


def main(arguments: Sequence[str]) -> int:
    """Runs Hydra on the arguments; then aggregates and shows the folders that were filled."""
    global _outcome
    _outcome = Outcome()
    _outcome.command = shlex.join(["ipe-bench", "run", *arguments])
    if any(word in ("-h", "--help") for word in arguments):
        flags, words = ["--help"], []
    else:
        flags, words = _flags_and_words(arguments)
    prepare()
    if "--shell-completion" in flags:
        _check_completion(words)
    elif words:
        folders = [Path(flags[i + 1]) for i, flag in enumerate(flags) if flag == "--config-dir"]
        words = rewrite(words)
        overrides = read(words, KEYS, folders)
        if not {"--config-name", "--config-path"}.intersection(flags):
            check_options(words, overrides)
        name = default_name(overrides)
        if not {"--multirun", "--run", "--cfg", "--info"}.intersection(flags) and sweeps_by_itself(words, folders):
            flags.append("--multirun")
        words = [*words, f"default_name='{name}'"]
    with contextlib.ExitStack() as stack:
        if "--dry-run" in flags:
            _outcome.dry = DryRun()
            flags.remove("--dry-run")
            # Hydra would begin a folder of results for its own log.
            log = stack.enter_context(tempfile.TemporaryDirectory(prefix="ipe-bench-"))
            words += [f"hydra.run.dir='{log}'", f"hydra.sweep.dir='{log}'"]
        _run_hydra(flags, words)
        return _conclude()


def _run_hydra(flags: Sequence[str], words: Sequence[str]) -> None:
    # Hydra would print config errors itself, badly, and exit with 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = ["ipe-bench", *flags, *words]
    try:
        told = _without_asking(RunMode.RUN) if _is_plain(flags, words) else contextlib.nullcontext()
        with flags_of_hydra(), told, _composing_jobs_once():
            hydra.main(version_base="1.3", config_path=str(plugins.own_conf()), config_name="config")(task)()
    except (UserError, StorageError):
        raise
    except OSError as error:  # Hydra writes its own files before our task is called
        if isinstance(error, MissingConfigException):
            raise explain(error) from error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        where, reason = shortened(str(error.filename or "output")), error.strerror or str(error)
        raise UserError(
            f"output: {where} cannot be written to ({reason}); choose another folder with output="
        ) from error
    except Exception as error:
        # What Hydra makes of overrides raises nearly anything; what our own task raises is a bug.
        if _outcome.bug is not None or plugins.blame(error):
            raise
        raise explain(error) from error


def _is_plain(flags: Sequence[str], words: Sequence[str]) -> bool:
    """Whether nothing that is asked for can say hydra.mode: neither a word, nor an experiment, nor another folder."""
    asks = any("hydra" in word or "experiment" in word for word in words)
    return not flags and not asks and len(plugins.sources()) == 1


@contextlib.contextmanager
def _composing_jobs_once() -> Iterator[None]:
    """Hydra composes every job of a sweep to see whether it can be, and again to run it: the first config is kept."""
    compose, kept = ConfigLoader.load_sweep_config, {}

    def composed(self: ConfigLoader, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        key = tuple(sweep_overrides)
        known = kept.pop(key, None)
        if known is None:
            known = compose(self, master_config, sweep_overrides)
            if len(kept) < _KEPT_CONFIGS:
                kept[key] = known
        return known

    ConfigLoader.load_sweep_config = composed
    try:
        yield
    finally:
        ConfigLoader.load_sweep_config = compose


@contextlib.contextmanager
def _without_asking(mode: RunMode) -> Iterator[None]:
    """Hydra composes the whole config once more only to learn its mode: here it is told."""
    asked = Hydra.get_mode
    Hydra.get_mode = lambda self, config_name, overrides: mode
    try:
        yield
    finally:
        Hydra.get_mode = asked


def _conclude() -> int:
    """Shows what the jobs came to; the exit code."""
    if _outcome.storage is not None:
        raise _outcome.storage
    if not _outcome.started:
        return 0
    if _outcome.multirun and not _outcome.elsewhere and not _outcome.jobs and not _outcome.mistakes:
        raise UserError("the sweep has no jobs: check the patterns in its lists")
    code = 1 if _outcome.failures or _outcome.short else 0
    if _outcome.dry is not None and not _outcome.mistakes:
        print(_outcome.dry.summary())
        return code
    end_idle()  # a report on many trials has use for their memory
    for output, words, reason, job in _outcome.refusals:
        if job is None:
            record_refusal(output, words, reason)
        else:
            record_refusal(output, words, reason, job.scenario, job.estimators, job.count)
    for output, cells in _outcome.outputs.items():
        if (output / "trials").is_dir():
            # Of jobs in other processes nothing is known but the folder.
            which, formats = _outcome.figures, _outcome.formats
            words = [str(output), f"figures={which}", f"formats={','.join(formats)}"]
            own = show_command(output, cells, which, formats) if cells else report(words)
            code = max(code, own)
    if _outcome.objectives:
        console().print(_outcome.shown_objective(), markup=False, soft_wrap=True)
    for line in _outcome.stops:
        console().print(line, markup=False, soft_wrap=True)
    if _outcome.mistakes:
        jobs = {r: w[0] + f" and {len(w) - 1} more" * (len(w) > 1) for r, w in _outcome.mistakes.items()}
        told = _outcome.multirun and _outcome.jobs > 1
        raise UserError("; ".join(f"{reason} (refused: {which})" if told else reason for reason, which in jobs.items()))
    return code


def _flags_and_words(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Flags and overrides apart: Hydra's parser wants all flags before or after all overrides."""
    waiting = list(arguments)
    for i, word in enumerate(waiting):
        # Hydra takes the topic as optional: what follows may be an override as well.
        if word in ("-i", "--info") and (i + 1 == len(waiting) or waiting[i + 1] not in INFO_TOPICS):
            waiting[i] = "--info=all"
    values = vars(parsers()[1]["run"].parse(waiting))
    words = values.pop("overrides")
    flags: list[str] = []
    for name, value in values.items():
        if value:
            flags += [f"--{name.replace('_', '-')}", *([] if value is True else [value])]
    commands = [f for f in flags if f in ("--run", "--multirun", "--cfg", "--info", "--shell-completion")]
    if len(commands) > 1:
        raise UserError(f"run: {' '.join(commands)}: do not go together; choose one")
    if "--resolve" in flags and "--cfg" not in flags:
        raise UserError("run: --resolve: goes with --cfg, such as --cfg job --resolve")
    for name in ("config_dir", "config_path"):
        if values[name] is not None and not Path(values[name]).is_dir():
            raise UserError(f"run: --{name.replace('_', '-')}={values[name]}: there is no such folder")
    if values["experimental_rerun"] is not None and not Path(values["experimental_rerun"]).is_file():
        raise UserError(f"run: --experimental-rerun={values['experimental_rerun']}: there is no such file")
    return flags, words


def sweeps_by_itself(words: Sequence[str], folders: Sequence[Path]) -> bool:
    """Whether the experiment that is asked for sweeps: then nobody has to say -m as well."""
    for word in words:
        group, _, name = word.lstrip("+").partition("=")
        path = known_options("experiment", folders).get(name) if group == "experiment" else None
        if path is not None:
            config = OmegaConf.load(path)
            return bool(OmegaConf.select(config, "hydra.sweeper.params")) and not OmegaConf.select(config, "hydra.mode")
    return False


def task(config: DictConfig) -> float | None:
    """One job: a scenario under its estimators. A mistake in one job of a sweep does not stop the others, unless they
    are chosen by what this one comes to, which it returns."""
    if _outcome.storage is not None:
        return None
    job = None
    try:
        job = assemble(config)
        _refuse_keys_without_use(config)
        if config.write_readings is not None:
            write_trial(job, Path(config.write_readings), config.write_readings_trial)
            return None
        if _outcome.dry is not None:
            print(_outcome.dry.add(job, _title(job)))
            return None
        interrupts.begin_work()
        with shown_progress(_title(job)) as watch:
            failures = _compute(job, Serial() if _launched_elsewhere() else job.execution, watch)
        value = None if job.objective is None else _objective(job)
    except (UserError, StorageError, *CONFIG_ERRORS) as error:
        if _launched_elsewhere() or _chosen_by_results():
            raise explain(error) if isinstance(error, CONFIG_ERRORS) else error from None
        if isinstance(error, StorageError):
            _outcome.storage = error
        else:
            reason = str(explain(error) if isinstance(error, CONFIG_ERRORS) else error)
            _outcome.mistakes.setdefault(reason, []).append(_job_words())
            if _outcome.multirun and _outcome.dry is None and config.write_readings is None:
                _outcome.refusals.append((Path(config.output), _job_words(), reason, job))
    except Exception as error:
        _outcome.bug = error
        raise
    else:
        _outcome.failures += failures
        accept(job.output, _job_words())
        _outcome.figures, _outcome.formats = job.figures, job.formats
        own = _outcome.outputs.setdefault(Path(job.output), {})
        own.update((cell.key, describe_names(cell.names)) for cell in result_keys(job.scenario, job.estimators))
        return value
    return None


def _objective(job: Spec) -> float:
    from ipe_bench.statistics.stopping import objective

    assert job.objective is not None
    value = objective(job.scenario, job.estimators, *job.aim, job.output)
    words = [word for word in HydraConfig.get().overrides.task if not word.startswith("objective=")]
    _outcome.objectives.append((value, words))
    return value


def _compute(job: Spec, execution: Execution, watch: Watcher) -> tuple[str, ...]:
    """Computes the trials that are asked for, or just enough; returns the messages of what failed."""
    options: dict[str, Any] = {"execution": execution, "block_size": job.block_size, "watch": watch}
    options["command"] = _outcome.command
    if job.precision is None:
        return compute([job.scenario], job.estimators, job.count, job.output, **options)
    from ipe_bench.statistics.stopping import compute_until

    options |= {"precision": job.precision, "time_limit": job.time_limit}
    failures, (stop,) = compute_until([job.scenario], job.estimators, job.count, job.output, **options)
    verdict = "" if stop.reached else "the precision is not reached: "
    line = f"{_title(job)}: {stop.trials} trials; {verdict}{stop.reason} ({stop.widest})"
    _outcome.short |= not stop.reached
    if _launched_elsewhere():
        print(line)
    _outcome.stops.append(line)
    return failures


def _refuse_keys_without_use(config: DictConfig) -> None:
    if config.readings is not None:
        raise UserError(
            f"readings={config.readings}: run simulates its readings; `ipe-bench estimate` estimates from a file"
        )
    for key in ("ignore_rows", "ignore_columns"):
        if config[key] is not None:
            raise UserError(f"{key}={config[key]}: is of a file of readings, for `ipe-bench estimate`; leave it out")
    if config.write_readings is None and config.write_readings_trial:
        raise UserError(f"write_readings_trial={config.write_readings_trial}: goes with write_readings=FILE")


def _launched_elsewhere() -> bool:
    """Whether a launcher plugin of Hydra (joblib, submitit) runs the jobs: then the cores are its to share out."""
    launcher = HydraConfig.get().launcher
    return HydraConfig.get().mode == RunMode.MULTIRUN and not launcher["_target_"].endswith(_OWN_LAUNCHER)


def _chosen_by_results() -> bool:
    """Whether a sweeper chooses the next jobs by what the last came to: it cannot go on from one that failed."""
    hydra_config = HydraConfig.get()
    return hydra_config.mode == RunMode.MULTIRUN and not hydra_config.sweeper["_target_"].endswith(".BasicSweeper")


_IN_EVERY_TITLE = {"measurement", "measurement.dataset", "truth_measurement", "noise", "error_scale", "seed"}
_NOT_IN_TITLES = {
    "trials",
    "precision",
    "time_limit",
    "objective",
    "block_size",
    "figures",
    "formats",
    "output",
    "name",
    "default_name",
    "experiment",
    "solver",
    "baseline",
}


def _job_words() -> str:
    """What tells a job of a sweep from the others: its words, as they were typed."""
    keys = {word: word.lstrip("+~").partition("=")[0] for word in HydraConfig.get().overrides.task}
    told = [word for word, key in keys.items() if key not in _NOT_IN_TITLES and not key.startswith("execution")]
    return " ".join(told) or "the job"


def _title(job: Spec) -> str:
    """What a job is about, for its progress bar: everything that may tell it from other jobs of a sweep."""
    scenario, chosen = job.scenario, HydraConfig.get().runtime.choices
    model = scenario.measurement
    parts = [str(chosen.get("measurement", model.name)) + (f" {model.dataset}" if isinstance(model, Nist) else "")]
    if scenario.truth is not None:
        parts.append(f"truth {chosen.get('measurement@truth_measurement', scenario.truth.name)}")
    if not scenario.noise.real:
        parts += [scenario.noise.name, f"error scale {scenario.error_scale:g}", f"seed {scenario.seed}"]
    for word in HydraConfig.get().overrides.task:
        key = word.lstrip("+~").partition("=")[0].partition("@")[-1] or word.lstrip("+~").partition("=")[0]
        if key not in _IN_EVERY_TITLE | _NOT_IN_TITLES and not key.startswith("execution"):
            word = word.lstrip("+")
            parts.append(word if len(word) <= 40 else f"{word[:30]}… #{digest(word)[:6]}")
    return ", ".join(parts)


def write_trial(job: Spec, path: Path, trial: int) -> None:
    """Writes the simulated readings of one trial, and its true parameters beside them."""
    from ipe_bench.real.readings import write_readings, write_truth

    if trial < 0:
        raise UserError(f"write_readings_trial={trial}: give a whole number from 0 up")
    drawn = job.scenario.draw(trial, trial + 1)
    model = job.scenario.measurement
    if not path.name:
        raise UserError(f"write_readings={path}: name a file")
    truth = path.with_name(f"{path.stem}.truth.csv")
    if truth.exists():
        raise UserError(f"{truth}: is there already and is not overwritten; name another file or remove it")
    write_readings(path, model, drawn.z[0])
    write_truth(truth, model, drawn.x[0])
    print(f"Readings of trial {trial}: {path}\nTrue parameters:     {truth}")


def _check_completion(words: Sequence[str]) -> None:
    """What `-sc` may be followed by, which Hydra looks up without checking."""
    shells = ("bash", "fish", "zsh")
    if not any(list(words) == [f"{what}={shell}"] for what in ("install", "uninstall", "query") for shell in shells):
        shown = " ".join(words) or "nothing"
        raise UserError(f"-sc {shown}: write -sc install=SHELL or -sc uninstall=SHELL, SHELL being {', '.join(shells)}")
    if words[0].startswith("query") and "COMP_LINE" not in os.environ:
        raise UserError(f"-sc {words[0]}: is what a shell asks while completing, with COMP_LINE set")
    _complete_without_subcommand()


def _complete_without_subcommand() -> None:
    """Hydra completes the words after the program's name; ours has the subcommand in between."""
    line = os.environ.get("COMP_LINE")
    if line is None:
        return
    program, _, rest = line.partition(" run ")
    if rest or line.endswith(" run "):
        os.environ["COMP_LINE"] = f"{program} {rest}"
        os.environ["COMP_POINT"] = str(len(os.environ["COMP_LINE"]))
