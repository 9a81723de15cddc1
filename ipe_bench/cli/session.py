"""Composes, sweeps and launches with Hydra, and returns each job's result.

`GlobalHydra.instance().hydra` is what `hydra.compose` itself works with. Its `multirun` returns
what the jobs returned, from other processes as well (joblib, submitit).
"""

from __future__ import annotations

import contextlib
import copy
import functools
import itertools
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from ipe_bench.basics.errors import StorageError, UserError, describe_exception, unknown
from ipe_bench.cli import print_problems
from ipe_bench.cli import words as w
from ipe_bench.cli.hydra_keys import Guarded
from ipe_bench.cli.search_path import extend
from ipe_bench.cli.spec import DEFAULTS, KEYS, Spec, spec
from ipe_bench.cli.words import Words
from ipe_bench.measurements.nist import FORMULAS
from ipe_bench.plugins import discovery as plugins


class PluginConfigs(SearchPathPlugin):
    """Lets our own commands find the options of plugins, and a user's own folder first."""

    folder: Path | None = None
    name = "config"
    """The primary config."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if self.folder is not None:
            search_path.prepend("command-line", self.folder.resolve().as_uri())
        extend(search_path, plugins.sources())


@functools.cache
def _register() -> None:
    """Tells Hydra, once in a process, what configs there are besides files."""
    store = ConfigStore.instance()
    store.store("schema", node=DEFAULTS, provider="ipe-bench")
    for name in FORMULAS:
        node = {"_target_": "ipe_bench.measurements.Nist", "dataset": name}
        store.store(
            name.lower(),
            node,
            group="measurement/nist",
            package="measurement",
            provider="ipe-bench",
        )
    registry = Plugins.instance()
    if PluginConfigs not in registry.discover(SearchPathPlugin):
        registry.register(PluginConfigs)


@contextlib.contextmanager
def session(folder: Path | None = None, name: str = "config") -> Iterator[None]:
    """Lets Hydra find our configs, those of plugins, and those in `folder` within its block; `name`
    is that of the primary config."""
    print_problems(plugins.take_problems())
    for own in ("config.yaml", "schema.yaml", "hydra/config.yaml"):
        if folder is not None and (folder / own).exists():
            raise UserError(
                f"{folder / own}: would replace ipe-bench's own config; move it to"
                " experiment/NAME.yaml"
            )
    _register()
    PluginConfigs.folder = folder
    PluginConfigs.name = name
    _composed.cache_clear()
    GlobalHydra.instance().clear()
    # Hydra 1.3 asks for the version whose rules hold, and 1.4 warns of whoever says one.
    base = {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}
    with initialize_config_dir(str(plugins.own_conf()), job_name="ipe-bench", **base):
        _hydra().config_loader = Guarded(_hydra().config_loader.get_search_path())
        yield


def _trusting() -> contextlib.AbstractContextManager[Any]:
    """Lets Hydra 1.4 construct the classes that configs name, which were judged when the files were
    read; 1.3 asks for no leave."""
    of_hydra: Any = hydra.utils
    if not hasattr(of_hydra, "execution_whitelist"):
        return contextlib.nullcontext()
    return of_hydra.execution_whitelist(of_hydra.UNSAFE_DISABLE_EXECUTION_CHECKS)


def _hydra() -> Any:
    return GlobalHydra.instance().hydra


_DIED = {"KilledWorker", "UncompletedJobError"}
"""Exceptions by which Dask and submitit say that a worker is gone; joblib has Python's own."""


@dataclass(frozen=True)
class Jobs:
    """Holds the jobs of a command, each checked."""

    words: Words
    specs: list[Spec]
    """Checked jobs; for a sweep whose jobs only its sweeper can choose, the first."""
    multirun: bool
    optimises: bool = False
    """Whether a sweeper chooses the jobs by what those before them gave."""
    maximises: bool = False
    told: list[list[str]] = field(default_factory=list)
    """The words of each job that this process runs; empty where Hydra's sweepers and launchers are
    to run them. Hydra's own launcher composes each job twice again, longer than a job of a few
    trials takes (`hydra/launcher=basic`)."""

    def launch(self, task: Callable[[DictConfig], Any]) -> list[Any]:
        """Returns each job's result, run by the launcher and the sweeper that the words choose;
        empty for a sweeper that optimises."""
        try:
            with _trusting():
                if not self.multirun:
                    return [_hydra().run(PluginConfigs.name, task, self.words.text).return_value]
                batches = _hydra().multirun(PluginConfigs.name, task, self.words.text)
        except (HydraException, OmegaConfBaseException) as error:
            raise explain(error) from error
        except Exception as error:
            name = type(error).__name__
            if not (isinstance(error, BrokenExecutor) or name in _DIED):
                raise
            raise StorageError(
                f"a worker of the launcher was killed ({name}); earlier results are intact: run the"
                " same command to resume"
            ) from None
        return [job.return_value for batch in batches or [] for job in batch]


def jobs_of(words: Words, *, multirun: bool) -> Jobs:
    """Returns the jobs of a command; an experiment that sweeps needs no flag for it."""
    config = _composed(tuple(map(w.forced, w.settled(words.overrides))), whole=True)
    hydra = config.hydra
    swept = hydra.sweeper.get("params") or {}
    params = [f"{key}={value}" for key, value in swept.items()]
    multirun = multirun or hydra.mode == RunMode.MULTIRUN or bool(params)
    optimises = not hydra.sweeper["_target_"].endswith(".BasicSweeper")
    for one in words.overrides:
        if one.is_sweep_override() and not multirun:
            listed = "." in one.key_or_group or one.key_or_group in plugins.PACKAGES
            remedy = (
                ", or put a list in brackets"
                if listed
                else f" for a job of each {one.key_or_group}"
            )
            raise UserError(f"{w.said(one)}: is a sweep; add -m{remedy}")
        if one.is_interval_sweep() and not optimises:
            raise UserError(
                f"{w.said(one)}: interval() is for sweepers that optimise (hydra/sweeper=optuna);"
                " give the values, such as 1,10,100"
            )
    if multirun and optimises:
        maximises = "maximize" in str(hydra.sweeper.get("direction", ""))
        return Jobs(words, [spec_of(config)], True, optimises, maximises)
    if multirun:
        jobs = _swept(words, params)
        specs = [_spec(job) for job in jobs]
    else:
        jobs = [list(words.overrides)]
        specs = [spec_of(config)]
    typed = any(one.is_hydra_override() for one in words.overrides)
    ours = hydra.launcher["_target_"].endswith(".BasicLauncher")
    if typed or not ours or _told_by_folder(hydra):
        return Jobs(words, specs, multirun)
    return Jobs(words, specs, multirun, told=[list(map(w.forced, job)) for job in jobs])


def _told_by_folder(hydra: DictConfig) -> bool:
    """Returns whether a folder of a person's tells Hydra more about jobs than to run them."""
    if PluginConfigs.folder is None:
        return False
    plain = _composed((), whole=True).hydra
    keys = ("callbacks", "hydra_logging", "job_logging", "job.chdir", "job.env_set", "job.env_copy")
    return any(OmegaConf.select(hydra, key) != OmegaConf.select(plain, key) for key in keys)


def _swept(words: Words, params: Sequence[str]) -> list[list[Override]]:
    """Returns the overrides of each job of a sweep, over `params` of an experiment, too."""
    own = [OverridesParser.create().parse_override(word) for word in params]
    jobs = list(itertools.islice(w.jobs([*own, *words.overrides]), w.MOST_JOBS + 1))
    if not 0 < len(jobs) <= w.MOST_JOBS:
        number = f"more than {w.MOST_JOBS}" if jobs else "no"
        raise UserError(
            f"the sweep has {number} jobs: give 1 to {w.MOST_JOBS}, and check its patterns"
        )
    return jobs


def _spec(job: Sequence[Override]) -> Spec:
    """Checks one job: composed for its choices, then completed with its other values."""
    choices = tuple(w.forced(one) for one in job if w.chooses(one))
    config = copy.deepcopy(_composed(choices))
    try:
        for one in job:
            if not w.chooses(one):
                value = w.plain(one.value())
                OmegaConf.update(config, one.key_or_group, value, merge=True, force_add=True)
    except Exception as error:
        raise explain(error) from error
    return spec_of(config)


@functools.lru_cache(maxsize=64)
def _composed(words: tuple[str, ...], *, whole: bool = False) -> DictConfig:
    try:
        config = compose(PluginConfigs.name, list(words), return_hydra_config=True)
    except RecursionError:
        chosen = next((word for word in words if "experiment=" in word), " ".join(words))
        raise UserError(f"{chosen}: its defaults lead back to itself; remove one of them") from None
    except Exception as error:  # what Hydra makes of overrides raises nearly anything
        raise explain(error) from error
    if not whole:
        with open_dict(config):
            del config["hydra"]
    return config


def spec_of(config: DictConfig) -> Spec:
    """Checks the job of a composed config."""
    return spec(_plain(config))


def composed(words: Words) -> dict[str, Any]:
    """Composes the config of a command's only job."""
    return _plain(_composed(tuple(map(w.forced, words.overrides)), whole=True))


def _plain(config: DictConfig) -> dict[str, Any]:
    try:
        own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        return OmegaConf.to_container(own, resolve=True, throw_on_missing=True)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        raise explain(error) from error


def show(words: Words, flags: Any) -> None:
    """Answers the flags that print and compute nothing, by Hydra's own means."""
    settled = [w.forced(one) for one in w.settled(words.overrides)]
    if flags.hydra_help:
        flags.overrides = [w.forced(one) for one in words.overrides if one.is_hydra_override()]
        _hydra().hydra_help(PluginConfigs.name, get_args_parser(), flags)
    elif flags.info:
        _hydra().show_info(flags.info, PluginConfigs.name, settled, RunMode.RUN)
    else:
        _hydra().show_cfg(PluginConfigs.name, settled, flags.cfg, flags.package, flags.resolve)


def complete(words: Sequence[str], commands: Collection[str]) -> None:
    """Installs Hydra's completion, or answers a shell, which sets COMP_LINE, with our commands or
    with what Hydra completes behind one."""
    asked = re.fullmatch("(install|uninstall|query)=(bash|fish|zsh)", " ".join(words))
    line = os.environ.get("COMP_LINE")
    if asked is None or (asked[1] == "query" and line is None):
        shown = " ".join(words) or "nothing"
        raise UserError(
            f"-sc {shown}: write -sc install=SHELL or -sc uninstall=SHELL, SHELL being bash, fish,"
            " zsh"
        )
    if line is not None:
        typed = line.split(" ")
        if len(typed) == 2 and "=" not in line:
            meant = [name for name in commands if name.startswith(typed[1])]
            print(("\n" if asked[2] == "fish" else " ").join(meant))
            return
        # Hydra completes the words after the program's name; ours has the command in between.
        if typed[1:2] and typed[1] in commands:
            del typed[1]
        os.environ["COMP_LINE"] = " ".join(typed)
        os.environ["COMP_POINT"] = str(len(os.environ["COMP_LINE"]))
    _hydra().shell_completion(PluginConfigs.name, list(words))


def explain(error: BaseException) -> UserError:
    """Words an error of Hydra, OmegaConf or YAML while composing, as one line with the remedy."""
    if isinstance(error, UserError):
        return error
    if isinstance(error, yaml.YAMLError):
        return UserError(plugins.explain_yaml(error))
    text = "\n".join(str(e) for e in (error, error.__cause__) if e is not None)
    for pattern, explained in _EXPLAINED:
        found = re.search(pattern, text)
        if found:
            return UserError(explained(*found.groups()))
    full_key = re.search(r"full_key: (\S+)", text)
    lines = dict.fromkeys(line.strip() for line in text.splitlines())
    kept = [line for line in lines if line and not line.startswith(_DETAILS)]
    where = f"{full_key.group(1)}: " if full_key else ""
    what = " ".join(kept) or describe_exception(error)
    return UserError(where + what)


_DETAILS = ("object_type=", "full_key:", "reference_type=", "See ")
"""How lines of OmegaConf begin that tell a user nothing."""
_EXTRAS = ("joblib", "submitit", "optuna")
"""Launchers and sweepers that are extras of our own distribution."""
_HYDRAS = ("ax", "nevergrad", "ray", "rq")
"""Further ones of Hydra's makers, each a package of its own."""


def _no_such_option(name: str) -> str:
    group, _, option = name.rpartition("/") if name.startswith("hydra/") else name.partition("/")
    if group in ("hydra/launcher", "hydra/sweeper"):
        kind = group.partition("/")[2]
        first = option.partition("_")[0]  # submitit_local is submitit's
        packages = {name: f'"ipe-bench[{name}]"' for name in _EXTRAS}
        packages |= {name: f"hydra-{name}-{kind}" for name in _HYDRAS}
        remedy = f"pip install {packages[first]}, or " if first in packages else ""
        return f"{group}={option}: this {kind} is not installed; {remedy}choose basic"
    known = [one.name for one in plugins.options(group)]
    return f"{group}={option}: {unknown(option, known, 'option')}"


def _no_such_key(name: str) -> str:
    known = {*KEYS, *plugins.groups(), "hydra"}
    key = name.split(".")[0]
    if key == "hydra":
        return f"{name}: is not there yet; write +{name}=VALUE, or see `ipe-bench run --cfg hydra`"
    if key in known:
        return f"{name}: there is no such key; see `ipe-bench run --cfg job` for those there are"
    return f"{name}: {unknown(key, known, 'key')}"


_FORMS = {
    "measurement.of": "=MODULE:FUNCTION",
    "measurement.expression": "=FORMULA",
    "measurement.rates": ".STATE=FORMULA",
    "state_model.next": ".STATE=FORMULA",
    "state_model.readings": ".READING=FORMULA",
    "state_model.deviation": ".READING=VALUE",
    "state_model.spread": ".STATE=VALUE",
}
_EXPLAINED: tuple[tuple[str, Callable[..., str]], ...] = (
    (r"Could not (?:find|load) '([^']+)'", _no_such_option),
    (r"Could not override '([^']+)'", _no_such_key),
    (r"An item is already at '([^']+)'", lambda key: f"{key}: is there already; leave out the +"),
    (
        r"Error merging override (\S+)\s+Invalid value '([^']+)', expected one of \[([^]]+)\]",
        lambda word, value, choices: f"{word}: {value} cannot be chosen (there are: {choices})",
    ),
    (
        r"Interpolation key '([^']+)' not found\s+full_key: (\S+)",
        lambda k, key: f"{key}: ${{{k}}} is no key of the config",
    ),
    (
        r"Missing mandatory value: \S+[\s\S]*full_key: (\S+)",
        lambda key: f"{key}: is not given; write {key}{_FORMS.get(key, '=VALUE')}",
    ),
)
"""Line for each message of Hydra."""
