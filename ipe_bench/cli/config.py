"""From the command line through Hydra to scenarios and estimators, with Hydra's silent traps closed."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.nist import datasets
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.runs.execution import Execution
from ipe_bench.runs.provenance import TARGET
from ipe_bench.trials.scenario import Scenario

CONFIG_ERRORS = (HydraException, OmegaConfBaseException)


@dataclass
class Schema:
    """The keys of a run besides the groups, with their types."""

    name: str = "run"
    """Names the output folder."""
    output: str = MISSING
    error_scale: float = 1.0
    """Standard deviation of the true parameters, in multiples of their units."""
    seed: int = 0
    trials: int = 1000
    block_size: int = 250
    """Trials per unit of work and of storage; changes no number."""
    readings: str | None = None
    """A file of real readings, for `estimate`."""
    write_readings: str | None = None
    """Write the simulated readings of one trial to this file instead of running."""
    write_readings_trial: int = 0
    measurement: Any = MISSING
    truth_measurement: Any = None
    """What simulates the readings, where it differs from what the estimators assume."""
    noise: Any = MISSING
    prior: Any = MISSING
    execution: Any = MISSING
    estimators: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Job:
    """One composed config, constructed."""

    scenario: Scenario
    estimators: Mapping[str, Estimator]
    execution: Execution
    trials: int
    block_size: int
    output: str


class PluginSearchPath(SearchPathPlugin):
    """Lets Hydra find the options of plugins."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for source in plugins.sources()[1:]:
            search_path.append(source.name, source.conf.as_uri())


def prepare() -> None:
    """Makes the schema and the plugins known to Hydra, and checks that every option can be chosen."""
    plugins.options()
    ConfigStore.instance().store("schema", node=Schema, provider="ipe-bench")
    registry = Plugins.instance()
    if PluginSearchPath not in registry.discover(SearchPathPlugin):
        registry.register(PluginSearchPath)


def rewrite(overrides: Sequence[str]) -> list[str]:
    """Overrides in Hydra's own words: truth_measurement= chooses from the group measurement, and measurement=nist/NAME
    is measurement=nist with that data set."""
    overrides = [re.sub(r"^(\+?)truth_measurement=", r"\1measurement@truth_measurement=", o) for o in overrides]
    return [part for override in overrides for part in _nist(override)]


def _nist(override: str) -> list[str]:
    """measurement=nist/misra1a, also in a sweep or as a pattern, as the option and its data set.

    Raises:
        UserError: there is no such data set, or other models stand in one sweep with them.
    """
    key, _, value = override.partition("=")
    if key.lstrip("+") not in ("measurement", "measurement@truth_measurement") or "nist/" not in value:
        return [override]
    known = {name.lower(): name for name in datasets()}
    pattern = re.fullmatch(r"glob\(nist/(.*)\)", value)
    if pattern:
        names = fnmatch.filter(known, pattern.group(1))
    else:
        options = [option.strip() for option in value.split(",")]
        if not all(option.startswith("nist/") for option in options):
            raise UserError(f"{override}: a sweep over measurement=nist has no other models in it; run them one by one")
        names = [option.removeprefix("nist/").lower() for option in options]
    if wrong := [name for name in names if name not in known]:
        raise UserError(f"measurement=nist/{wrong[0]}: {unknown(wrong[0], known, 'data set')}")
    if not names:
        raise UserError(f"{override}: fits no data set; write measurement=nist measurement.dataset=Misra1a")
    return [f"{key}=nist", f"{key.rpartition('@')[2].lstrip('+')}.dataset={','.join(known[name] for name in names)}"]


def assemble(config: DictConfig) -> Job:
    """The scenario, the estimators and the execution that a composed config describes; UserError by key."""
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    for key in plain:
        if key not in Schema.__dataclass_fields__:
            raise UserError(f"{key}: {unknown(str(key), Schema.__dataclass_fields__, 'key')}")
    parts = {key: construct(plain[key], key) for key in ("measurement", "noise", "prior", "execution")}
    truth = plain["truth_measurement"]
    scenario = Scenario(
        parts["measurement"],
        parts["noise"],
        parts["prior"],
        plain["error_scale"],
        plain["seed"],
        None if truth is None else construct(truth, "truth_measurement"),
    )
    estimators: dict[str, Estimator] = {}
    for label, options in plain["estimators"].items():
        if not isinstance(options, Mapping):
            raise UserError(f"estimators.{label}={options}: set its options, such as estimators.{label}.KEY=VALUE")
        if TARGET not in options:
            keys = ", ".join(f"estimators.{label}.{key}" for key in options)
            raise UserError(
                f"{keys}: is set, but {label} is not chosen; add it to solver= or baseline=, or leave it out"
            )
        estimators[str(label)] = construct(options, f"estimators.{label}")
    return Job(scenario, estimators, parts["execution"], plain["trials"], plain["block_size"], plain["output"])


def refuse_silent_traps(overrides: Sequence[str]) -> None:
    """Refuses what Hydra would take without a word and not do: see each message."""
    for override in overrides:
        key, _, value = override.partition("=")
        group = key.lstrip("+")
        if group == "experiment" and "," in value:
            raise UserError(f"{override}: a sweep over experiments would ignore their own sweeps; run them one by one")
        if group in plugins.ESTIMATOR_GROUPS and value.startswith("["):
            names = [name.strip() for name in value.strip("[]").split(",")]
            for name in names:
                if names.count(name) > 1:
                    remedy = f"+{group}@estimators.{name}_2={name} runs it again under a label of its own"
                    raise UserError(f"{override}: {name} stands there twice and would run once; {remedy}")


def explain(error: Exception) -> UserError:
    """A config error of Hydra or OmegaConf as one line with the remedy."""
    text = "\n".join(str(e) for e in (error, error.__cause__) if e is not None)
    missing = re.search(r"Could not (?:find|load) '([^']+)'", text)
    if missing:
        group, _, name = missing.group(1).partition("/")
        known = [option.name for option in plugins.options(group)]
        return UserError(f"{group}={name}: {unknown(name, known, 'option')}")
    no_group = re.search(r"Could not override '([^']+)'", text)
    if no_group:
        name = no_group.group(1)
        if name == "experiment":
            return UserError("experiment: is added, not overridden; write +experiment=NAME")
        known = {*Schema.__dataclass_fields__, *plugins.groups()}
        key = name.split(".")[0]
        if key in known:
            return UserError(f"{name}: there is no such key; see `ipe-bench run --cfg job` for those there are")
        return UserError(f"{name}: {unknown(key, known, 'key')}")
    full_key = re.search(r"full_key: (\S+)", text)
    value = re.search(r"Value '([^']*)' of type '[^']*' could not be converted to (\w+)", text)
    if value and full_key:
        kind = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false"}
        return UserError(f"{full_key.group(1)}={value.group(1)}: give {kind.get(value.group(2), value.group(2))}")
    lines = dict.fromkeys(line.strip() for line in text.splitlines() if line.strip())
    return UserError(" ".join(line for line in lines if not line.startswith("object_type=")))
