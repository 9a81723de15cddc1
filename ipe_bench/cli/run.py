"""`ipe-bench run`: composes the config with Hydra, computes what is missing, and shows what is known."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ipe_bench.api import compute
from ipe_bench.basics.errors import StorageError, UserError
from ipe_bench.cli.config import CONFIG_ERRORS, Job, assemble, explain, prepare, refuse_silent_traps, rewrite
from ipe_bench.cli.progress import shown_progress
from ipe_bench.cli.report import show
from ipe_bench.measurements import Nist
from ipe_bench.plugins import discovery as plugins
from ipe_bench.runs.execution import Serial
from ipe_bench.runs.store import digest

_FLAGS_WITH_VALUE = {"--cfg", "-c", "--package", "-p", "--config-name", "-cn", "--config-path", "-cp"}
_FLAGS_WITH_VALUE |= {"--config-dir", "-cd", "--experimental-rerun"}
_OWN_LAUNCHER = ".BasicLauncher"
_INFO_TOPICS = {"all", "config", "defaults", "defaults-tree", "plugins", "searchpath"}


class Outcome:
    """What the jobs of this invocation came to; Hydra hands nothing back from a sweep."""

    def __init__(self) -> None:
        self.started = False
        self.multirun = False
        self.elsewhere = False
        """Jobs run in other processes, from which nothing but an exception or a file comes back."""
        self.jobs = 0
        self.outputs: dict[Path, None] = {}
        self.failures: list[str] = []
        self.mistakes: dict[str, None] = {}
        self.storage: StorageError | None = None
        """Nothing can be stored any more: the remaining jobs are not begun."""


_outcome = Outcome()


class Watch(Callback):
    """Learns from Hydra which folder is being filled, also when a launcher runs the jobs elsewhere."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        _outcome.started = True

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        _outcome.started = _outcome.multirun = True
        _outcome.elsewhere = not config.hydra.launcher["_target_"].endswith(_OWN_LAUNCHER)
        output = OmegaConf.select(config, "output")
        if output is not None:
            _outcome.outputs[Path(output)] = None

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        _outcome.jobs += 1


def main(arguments: Sequence[str]) -> int:
    """Runs Hydra on the arguments; then aggregates and shows the folders that were filled."""
    global _outcome
    _outcome = Outcome()
    flags, overrides = hoist(arguments)
    refuse_silent_traps(overrides)
    prepare()
    _complete_without_subcommand()
    # Hydra would print config errors itself, badly, and exit with 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = ["ipe-bench", *flags, *rewrite(overrides)]
    try:
        hydra.main(version_base="1.3", config_path=str(plugins.own_conf()), config_name="config")(task)()
    except CONFIG_ERRORS as error:
        raise explain(error) from error
    except OSError as error:  # Hydra writes its own files before our task is called
        raise _explain_os_error(error) from error
    if _outcome.storage is not None:
        raise _outcome.storage
    if not _outcome.started:
        return 0
    if _outcome.multirun and not _outcome.elsewhere and not _outcome.jobs and not _outcome.mistakes:
        raise UserError("the sweep has no jobs: check the patterns in its lists")
    for failure in _outcome.failures:
        print(f"ipe-bench: failed: {failure}", file=sys.stderr)
    code = 1 if _outcome.failures else 0
    for output in _outcome.outputs:
        if (output / "trials").is_dir():
            code = max(code, show([output], output))
    if _outcome.mistakes:
        raise UserError("; ".join(_outcome.mistakes))
    return code


def task(config: DictConfig) -> None:
    """One job: a scenario under its estimators. A mistake in one job of a sweep does not stop the others."""
    if _outcome.storage is not None:
        return
    try:
        job = assemble(config)
        if config.write_readings is not None:
            write_trial(job, Path(config.write_readings), config.write_readings_trial)
            return
        with shown_progress(_title(job)) as watch:
            failures = compute(
                [job.scenario],
                job.estimators,
                job.trials,
                job.output,
                execution=Serial() if _launched_elsewhere() else job.execution,
                block_size=job.block_size,
                watch=watch,
            )
    except CONFIG_ERRORS as error:
        if _launched_elsewhere():
            raise explain(error) from None
        _outcome.mistakes[str(explain(error))] = None
    except UserError as error:
        if _launched_elsewhere():
            raise
        _outcome.mistakes[str(error)] = None
    except StorageError as error:
        if _launched_elsewhere():
            raise
        _outcome.storage = error
    else:
        _outcome.failures += failures
        _outcome.outputs[Path(job.output)] = None


def _launched_elsewhere() -> bool:
    """Whether a launcher plugin of Hydra (joblib, submitit) runs the jobs: then the cores are its to share out."""
    launcher = HydraConfig.get().launcher
    return HydraConfig.get().mode == RunMode.MULTIRUN and not launcher["_target_"].endswith(_OWN_LAUNCHER)


def _explain_os_error(error: OSError) -> Exception:
    where, reason = error.filename or "output", error.strerror or str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageError(f"{where}: {reason}; what was stored before is whole, and the same command goes on")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.ENOENT):
        return UserError(f"output: {where} cannot be written to ({reason}); choose another folder with output=")
    return error


def _title(job: Job) -> str:
    """What a job is about, for its progress bar: the option that was chosen, what is drawn, and what a sweep sets."""
    scenario = job.scenario
    hydra_config = HydraConfig.get()
    chosen = hydra_config.runtime.choices.get("measurement", scenario.measurement.name)
    if isinstance(scenario.measurement, Nist):
        chosen = f"{chosen} {scenario.measurement.dataset}"
    parts = [str(chosen)]
    if not scenario.noise.real:
        parts += [f"error scale {scenario.error_scale:g}", f"seed {scenario.seed}"]
    if hydra_config.mode == RunMode.MULTIRUN:
        said = ("measurement=", "error_scale=", "seed=", "trials=", "output=", "name=", "block_size=", "execution")
        settings = [o for o in hydra_config.overrides.task if not o.lstrip("+").startswith(said)]
        parts += [o if len(o) <= 40 else f"{o[:30]}… #{digest(o)[:6]}" for o in settings]
    return ", ".join(parts)


def write_trial(job: Job, path: Path, trial: int) -> None:
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


def hoist(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Flags and overrides apart: Hydra's parser wants all flags before or after all overrides."""
    flags: list[str] = []
    overrides: list[str] = []
    waiting = list(arguments)
    while waiting:
        argument = waiting.pop(0)
        if not argument.startswith("-"):
            overrides.append(argument)
            continue
        flags.append(argument)
        takes_next = argument in _FLAGS_WITH_VALUE
        takes_next |= argument in ("--info", "-i") and bool(waiting) and waiting[0] in _INFO_TOPICS
        takes_next |= argument in ("-sc", "--shell-completion") and bool(waiting)
        if takes_next and waiting:
            flags.append(waiting.pop(0))
    return flags, overrides


def _complete_without_subcommand() -> None:
    """Hydra completes the words after the program's name; ours has the subcommand in between."""
    line = os.environ.get("COMP_LINE")
    if line is None:
        return
    program, _, rest = line.partition(" run ")
    if rest or line.endswith(" run "):
        os.environ["COMP_LINE"] = f"{program} {rest}"
        os.environ["COMP_POINT"] = str(len(os.environ["COMP_LINE"]))
