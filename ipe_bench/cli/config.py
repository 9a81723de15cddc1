"""From the command line through Hydra to scenarios and estimators, with Hydra's silent traps closed."""

from __future__ import annotations

import fnmatch
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.known import Informed, Known
from ipe_bench.measurements.nist import datasets
from ipe_bench.noise import ModelNoise, Unknown
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.priors.gaussian import GaussianPrior
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
    readings: Any = None
    """A file of real readings, for `estimate`, or a list of files that are estimated together."""
    write_readings: str | None = None
    """Write the simulated readings of one trial to this file instead of running."""
    write_readings_trial: int = 0
    measurement: Any = MISSING
    truth_measurement: Any = None
    """What simulates the readings, where it differs from what the estimators assume."""
    noise: Any = MISSING
    prior: Any = MISSING
    parameters: Any = None
    """What is known of the parameters: parameters.NAME.fixed=, .nominal=, .deviation=, .lower=, .upper=, .positive=."""
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


_FORMULA = re.compile(
    r"^(\+*(?:truth_)?measurement\.(?:expression|(?:initial|rates|outputs)\.\w+))=(?!['\"])(.*)$", re.DOTALL
)
_FILE = re.compile(r"^\+*(?:truth_)?measurement\.file=")
_OPEN = re.compile(r"^(?:parameters|(?:truth_)?measurement\.(?:start|columns|initial|rates|outputs))\.")
"""Keys to which users add entries of their own names."""


def rewrite(overrides: Sequence[str]) -> list[str]:
    """Overrides in Hydra's own words: truth_measurement= chooses from the group measurement, measurement=nist/NAME is
    measurement=nist with that data set, formulas stand in quotes that the shell has taken off, and entries are added
    where users name them."""
    expanded = [words for o in overrides for words in (_from_file(o) if _FILE.match(o) else [_in_hydras_words(o)])]
    return [part for override in expanded for part in _nist(override)]


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


def _from_file(override: str) -> list[str]:
    """A model's options from a YAML file, as if each had been typed there."""
    key, _, name = override.partition("=")
    try:
        content = yaml.safe_load(Path(name).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{override}: cannot be read ({error.__class__.__name__}); name a YAML file") from None
    except yaml.YAMLError as error:
        raise UserError(f"{override}: is not YAML ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict):
        raise UserError(f"{override}: holds no keys; write a YAML file of options such as rates, start, outputs")
    if TARGET in content:
        raise UserError(f"{override}: has a {TARGET}; the model is chosen by measurement=, so leave it out")
    group = key.removesuffix(".file").lstrip("+")
    return [f"++{group}.{k}={_literal(v, override)}" for k, v in content.items()]


def _literal(value: Any, where: str) -> str:
    """A value in the grammar of overrides."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{k}:{_literal(v, where)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(_literal(v, where) for v in value) + "]"
    if isinstance(value, str):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    if value is None or isinstance(value, bool | int | float):
        return json.dumps(value) if value is None or isinstance(value, bool) else repr(value)
    raise UserError(f"{where}: {value!r} is neither text nor number")


def _in_hydras_words(override: str) -> str:
    override = re.sub(r"^(\+?)truth_measurement=", r"\1measurement@truth_measurement=", override)
    override = _FORMULA.sub(lambda found: f"{found[1]}='{found[2]}'", override)
    return f"++{override}" if _OPEN.match(override) else override


def assemble(config: DictConfig, *, estimating: bool = False) -> Job:
    """The scenario, the estimators and the execution that a composed config describes; UserError by key.

    `estimating`: for real readings, of which the level of the noise need not be known.
    """
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    for key in plain:
        if key not in Schema.__dataclass_fields__:
            raise UserError(f"{key}: {unknown(str(key), Schema.__dataclass_fields__, 'key')}")
    parts = {key: construct(plain[key], key) for key in ("measurement", "noise", "prior", "execution")}
    truth = plain["truth_measurement"]
    noise = parts["noise"]
    if estimating and isinstance(noise, ModelNoise):
        noise = noise.of(parts["measurement"]) or Unknown()
    truth = None if truth is None else construct(truth, "truth_measurement")
    measurement, prior = parts["measurement"], parts["prior"]
    known = _known(plain["parameters"])
    if known:
        measurement = Informed(measurement, known)
        truth = None if truth is None else Informed(truth, known)
        prior = _prior(prior, measurement)
    scenario = Scenario(measurement, noise, prior, plain["error_scale"], plain["seed"], truth)
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


def _known(given: Any) -> tuple[Known, ...]:
    """What the key `parameters` says of each."""
    if given is None:
        return ()
    if not isinstance(given, Mapping):
        raise UserError("parameters: give each what is known of it, such as parameters.NAME.fixed=0.1")
    found = []
    for name, options in given.items():
        where = f"parameters.{name}"
        if not isinstance(options, Mapping):
            raise UserError(f"{where}={options}: say what that is, such as {where}.fixed={options}")
        target = f"{Known.__module__}.{Known.__qualname__}"
        found.append(construct({TARGET: target, "name": str(name), **options}, where))
    return tuple(found)


def _prior(prior: GaussianPrior, model: Informed) -> GaussianPrior:
    """The prior with the deviations that are known of single parameters."""
    if prior.deviations is None:
        return replace(prior, deviations=model.prior_deviations)
    names = [p.name for p in model.whole.parameters]
    if len(prior.deviations) != len(names):
        raise UserError(
            f"prior.deviations: has {len(prior.deviations)} numbers; give one for each of {len(names)} parameters"
        )
    general = dict(zip(names, prior.deviations, strict=True))
    own = {one.name for one in model.known if one.deviation is not None}
    known = zip(model.natural_parameters, model.prior_deviations, strict=True)
    return replace(prior, deviations=tuple(d if p.name in own else general[p.name] for p, d in known))


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
    if isinstance(error, MissingMandatoryValue) and full_key:
        return UserError(f"{full_key.group(1)}: is not given; give it a value")
    lines = dict.fromkeys(line.strip() for line in text.splitlines() if line.strip())
    return UserError(" ".join(line for line in lines if not line.startswith("object_type=")))
