"""From the command line through Hydra to scenarios and estimators, with Hydra's silent traps closed."""

from __future__ import annotations

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

from ipe_bench import plugins
from ipe_bench.components import TARGET, construct, unknown
from ipe_bench.errors import UserError
from ipe_bench.estimation import Estimator
from ipe_bench.execution import Execution
from ipe_bench.scenario import Scenario

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
    """Overrides in Hydra's own words: truth_measurement= chooses from the group measurement."""
    return [re.sub(r"^(\+?)truth_measurement=", r"\1measurement@truth_measurement=", o) for o in overrides]


def assemble(config: DictConfig, choices: Mapping[str, Any]) -> Job:
    """The scenario, the estimators and the execution that a composed config describes.

    `choices` is what was chosen in each group. Raises UserError by key.
    """
    _check_choices(choices)
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
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
        if TARGET not in options:
            keys = ", ".join(f"estimators.{label}.{key}" for key in options)
            raise UserError(
                f"{keys}: is set, but {label} is not chosen; add it to solver= or baseline=, or leave it out"
            )
        estimators[str(label)] = construct(options, f"estimators.{label}")
    return Job(scenario, estimators, parts["execution"], plain["trials"], plain["block_size"], plain["output"])


def _check_choices(choices: Mapping[str, Any]) -> None:
    """Refuses what Hydra would silently merge."""
    chosen: dict[str, str] = {}
    for group in plugins.ESTIMATOR_GROUPS:
        for name in choices.get(group) or []:
            if name in chosen:
                other = chosen[name]
                remedy = f"+{group}@estimators.{name}_2={name} runs it a second time under another label"
                raise UserError(
                    f"{group}={name}: is chosen twice ({other} and {group}), which would run once; {remedy}"
                )
            chosen[name] = group


def explain(error: Exception) -> UserError:
    """A config error of Hydra or OmegaConf as one line with the remedy."""
    text = str(error)
    missing = re.search(r"Could not find '([^']+)'|In '[^']*': Could not find '([^']+)'", text)
    if missing:
        group, _, name = (missing.group(1) or missing.group(2)).partition("/")
        known = [option.name for option in plugins.options(group)]
        return UserError(f"{group}={name}: {unknown(name, known, 'option')}")
    no_group = re.search(r"Could not override '([^']+)'", text)
    if no_group:
        name = no_group.group(1)
        if name == "experiment":
            return UserError("experiment: is added, not overridden; write +experiment=NAME")
        known = [*Schema.__dataclass_fields__, *plugins.groups()]
        key = name.split(".")[0]
        if key in known:
            return UserError(f"{name}: there is no such key; see `ipe-bench run --cfg job` for those there are")
        return UserError(f"{name}: {unknown(key, known, 'key')}")
    full_key = re.search(r"full_key: (\S+)", text)
    value = re.search(r"Value '([^']*)' of type '[^']*' could not be converted to (\w+)", text)
    if value and full_key:
        kind = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false"}
        return UserError(f"{full_key.group(1)}={value.group(1)}: give {kind.get(value.group(2), value.group(2))}")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    lines += [f"({cause})" for cause in [error.__cause__] if cause is not None and str(cause) not in text]
    return UserError(" ".join(line for line in lines if not line.startswith("object_type=")))
