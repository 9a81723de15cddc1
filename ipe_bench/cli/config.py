"""From the command line through Hydra to scenarios and estimators, with Hydra's silent traps closed."""

from __future__ import annotations

import fnmatch
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import cloudpickle
import yaml
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ipe_bench.api import objective_columns
from ipe_bench.basics.errors import UserError, describe_exception, unknown
from ipe_bench.cli.search_path import extend
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.known import Informed, Known, informed
from ipe_bench.measurements.nist import datasets
from ipe_bench.noise import ModelNoise, Noise, Unknown
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.priors import GaussianPrior, Prior, prior_of
from ipe_bench.real.covariances import read_covariance
from ipe_bench.real.sources import Readings
from ipe_bench.report.choice import PAGE, Which, file_formats, which_figures
from ipe_bench.runs.execution import Execution
from ipe_bench.runs.provenance import TARGET, canonical_json, describe
from ipe_bench.runs.run import MOST_TRIALS, TRIALS
from ipe_bench.trials.scenario import Scenario

CONFIG_ERRORS = (HydraException, OmegaConfBaseException)
Opened: TypeAlias = Callable[[DictConfig, Measurement], Readings | None]


@dataclass
class Schema:
    """The keys of a run besides the groups, with their types."""

    default_name: str = "gins"
    """What the command was, in short: names the output folder where nothing else does."""
    name: str = "${default_name}"
    """Names the output folder."""
    output: str = MISSING
    error_scale: float = 1.0
    """Standard deviation of the true parameters, in multiples of their units."""
    seed: int = 0
    trials: int | None = None
    """1000 unless given; with a precision, the most there may be."""
    precision: Any = None
    """How near to what is found success shares have to be (0.01), or {success: 0.01, rmse: 0.05}: then there are just
    enough trials."""
    time_limit: float | None = None
    """Seconds after which, with a precision, no more blocks are begun."""
    figures: str = "main"
    """Which to draw: all, main (the few that answer the question), or none."""
    formats: Any = "png"
    """Of the figures' files: png, and what is named of pdf and svg as well."""
    block_size: int | None = None
    """Trials per unit of work; changes no number. 250 unless given, and up to 1000 of a hundred thousand trials."""
    readings: Any = None
    """A file of real readings, for `estimate`, or a list of files that are estimated together."""
    ignore_rows: Any = None
    """Rows of the file to leave out, by their numbers: their readings are missing. Of several files FILE:NUMBER."""
    ignore_columns: Any = None
    """Columns of the file to leave out."""
    write_readings: str | None = None
    """Write the simulated readings of one trial to this file instead of running."""
    write_readings_trial: int = 0
    measurement: Any = MISSING
    truth_measurement: Any = None
    """What simulates the readings, where it differs from what the estimators assume."""
    noise: Any = MISSING
    prior: Any = MISSING
    parameters: Any = None
    """What is known of the parameters: parameters.NAME.fixed=, .nominal=, .deviation=, .lower=, .upper=, .positive=; or
    a YAML file of that, parameters=FILE."""
    prior_covariance: Any = None
    """P0 of the parameters in their own units, at error scale 1: a matrix in their order, or a CSV file with their
    names in its header."""
    execution: Any = MISSING
    objective: str | None = None
    """LABEL.COLUMN, such as newton.capped_error: a number of each job, which sweepers that optimise make small."""
    estimators: dict[str, Any] = field(default_factory=dict)


KEYS = tuple(Schema.__dataclass_fields__)


@dataclass(frozen=True)
class Job:
    """One composed config, constructed."""

    scenario: Scenario
    estimators: Mapping[str, Estimator]
    execution: Execution
    trials: int
    """Or the most there may be, where there is a precision."""
    block_size: int | None
    output: str
    precision: Any = None
    time_limit: float | None = None
    objective: tuple[str, str] | None = None
    """The label of an estimator and a column of its row over all parameters."""
    readings: Readings | None = None
    """Of the files, for an estimate from them."""
    figures: Which = "main"
    formats: tuple[str, ...] = (PAGE,)


class PluginConfigs(SearchPathPlugin):
    """Lets our own commands find the options of plugins, those in the working folder as well."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        extend(search_path, plugins.sources())


def prepare() -> None:
    """Makes the schema and the plugins known to Hydra."""
    for problem in plugins.take_problems():
        print(f"ipe-bench: {problem}", file=sys.stderr)
    ConfigStore.instance().store("schema", node=Schema, provider="ipe-bench")
    registry = Plugins.instance()
    if PluginConfigs not in registry.discover(SearchPathPlugin):
        registry.register(PluginConfigs)


_FORMULA = re.compile(
    r"^(\+*(?:truth_)?measurement\.(?:expression|(?:initial|rates|outputs)\.\w+))=(?!['\"])(.*)$", re.DOTALL
)
_UNIT = re.compile(r"^(\+*(?:truth_)?measurement\.(?:time_)?unit)=([^'\",\[\]{}]+)$")
_FILE = re.compile(r"^\+*(?:truth_)?measurement\.file=")
_FORMATS = re.compile(r"^formats=(\w+(?:,\w+)+)$")
_PARAMETERS = re.compile(r"^\+*parameters=(?![{$]|null$)")
_OPEN = re.compile(
    r"^(?:(?:parameters|(?:truth_)?measurement\.(?:start|columns|constants|initial|rates|outputs))\."
    r"|execution\.options[.=])"
)
"""Keys to which users add entries of their own names."""


def rewrite(overrides: Sequence[str]) -> list[str]:
    """Overrides in Hydra's own words: truth_measurement= chooses from the group measurement, measurement=nist/NAME is
    measurement=nist with that data set, formulas stand in quotes that the shell has taken off, and entries are added
    where users name them."""
    expanded = [words for o in overrides for words in _expanded(o)]
    return [part for override in expanded for part in _nist(override)]


def _expanded(override: str) -> list[str]:
    """An override as it is, or what a file that it names says in its place."""
    if _FILE.match(override):
        return _from_file(override)
    if _PARAMETERS.match(override):
        return _from_file(override.replace("=", ".file=", 1))
    return [_in_hydras_words(override)]


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
    """Options from a YAML file, as if each had been typed there."""
    key, _, name = override.partition("=")
    group = key.removesuffix(".file").lstrip("+")
    said = override if group != "parameters" else f"{group}={name}"
    try:
        content = yaml.safe_load(Path(name).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{said}: cannot be read ({error.__class__.__name__}); name a YAML file") from None
    except yaml.YAMLError as error:
        raise UserError(f"{said}: is not YAML ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict):
        example = "NAME: {nominal: 1}" if group == "parameters" else "rates, start, outputs"
        raise UserError(f"{said}: holds no keys; write a YAML file of options such as {example}")
    if TARGET in content:
        raise UserError(f"{said}: has a {TARGET}; the model is chosen by measurement=, so leave it out")
    return [f"++{group}.{k}={_literal(v, said)}" for k, v in content.items()]


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
    # Several formats are no sweep.
    override = _FORMATS.sub(r"formats=[\1]", override)
    override = _UNIT.sub(lambda found: f"{found[1]}='{found[2]}'", override)
    override = _FORMULA.sub(lambda found: f"{found[1]}='{found[2]}'", override)
    return f"++{override}" if _OPEN.match(override) else override


def assemble(config: DictConfig, opened: Opened | None = None) -> Job:
    """The scenario, the estimators and the execution that a composed config describes; UserError by key.

    `opened` estimates from real readings: it opens the files that the config names. The level of their noise need not
    be known.
    """
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    for key in plain:
        if key not in KEYS:
            raise UserError(f"{key}: {unknown(str(key), KEYS, 'key')}")
    for key in KEYS:
        if key not in plain:
            raise UserError(f"{key}: is left out; give it a value")
    for key in ("name", "output"):
        if not Path(plain[key]).name:
            raise UserError(f"{key}={plain[key]}: name a folder")
    truth = plain["truth_measurement"]
    measurement, noise = _part(plain, "measurement", Measurement), _part(plain, "noise", Noise)
    truth = None if truth is None else _part(plain, "truth_measurement", Measurement)
    prior = _part(plain, "prior", Prior)
    readings = opened(config, measurement) if opened is not None else None
    if readings is not None:
        measurement = readings.model
    if opened is not None and isinstance(noise, ModelNoise):
        noise = noise.of(measurement) or Unknown()
    known = _known(plain["parameters"])
    if known:
        measurement = informed(measurement, known)
        truth = None if truth is None else informed(truth, known)
    if readings is not None:
        readings = replace(readings, model=measurement)
    prior = _prior(prior, measurement, plain["prior_covariance"])
    scenario = Scenario(measurement, noise, prior, plain["error_scale"], plain["seed"], truth)
    execution = _part(plain, "execution", Execution)
    estimators: dict[str, Estimator] = {}
    for label, options in (plain["estimators"] or {}).items():
        if not isinstance(options, Mapping):
            raise UserError(f"estimators.{label}={options}: set its options, such as estimators.{label}.KEY=VALUE")
        if TARGET not in options:
            keys = ", ".join(f"estimators.{label}.{key}" for key in options) or f"estimators.{label}"
            raise UserError(
                f"{keys}: is set, but {label} is not chosen; add it to solver= or baseline=, or leave it out"
            )
        _refuse_false_name(str(label), options[TARGET])
        estimators[str(label)] = _checked(construct(options, f"estimators.{label}"), f"estimators.{label}", Estimator)
    precision, time_limit = plain["precision"], plain["time_limit"]
    if time_limit is not None and precision is None:
        raise UserError(f"time_limit={time_limit}: goes with precision=; give that, or leave it out")
    unless = TRIALS if precision is None else MOST_TRIALS
    trials = unless if plain["trials"] is None else plain["trials"]
    block_size, output = plain["block_size"], plain["output"]
    objective = _objective(plain["objective"], list(estimators))
    figures = which_figures(plain["figures"])
    return Job(
        *(scenario, estimators, execution, trials, block_size, output, precision, time_limit, objective),
        readings=readings,
        figures=figures,
        formats=file_formats(plain["formats"]),
    )


def _objective(given: str | None, labels: Sequence[str]) -> tuple[str, str] | None:
    """The label and the column that objective=LABEL.COLUMN names."""
    if given is None:
        return None
    label, dot, column = given.rpartition(".")
    if not dot or label not in labels:
        what = unknown(label, labels, "estimator") if dot else "write LABEL.COLUMN, such as newton.capped_error"
        raise UserError(f"objective={given}: {what}")
    columns = objective_columns()
    if column not in columns:
        raise UserError(f"objective={given}: {unknown(column, columns, 'column')}")
    return label, column


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


def _prior(prior: Prior, model: Measurement, covariance: Any) -> Prior:
    """The prior with what is known of single parameters, or of all together."""
    deviating = isinstance(model, Informed) and any(one.deviation is not None for one in model.known)
    if covariance is not None:
        if not isinstance(prior, GaussianPrior):
            raise UserError(f"prior_covariance: is for prior=gaussian; with prior={prior.name}, leave it out")
        if deviating or prior != GaussianPrior():
            other = "parameters.NAME.deviation" if deviating else "prior.deviations or prior.correlations"
            raise UserError(f"prior_covariance: says all of the prior; leave out {other}")
        return prior_of(model, read_covariance(covariance, [p.name for p in model.natural_parameters]))
    return prior if not isinstance(model, Informed) else _informed_prior(prior, model)


def _informed_prior(prior: Prior, model: Informed) -> GaussianPrior:
    """The prior with the deviations that are known of single parameters."""
    if not isinstance(prior, GaussianPrior):
        raise UserError(f"parameters: goes with prior=gaussian, which is told of each; prior={prior.name} is not")
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


Part = TypeVar("Part")


def _part(plain: Mapping[Any, Any], key: str, kind: type) -> Any:
    config = plain[key]
    if not isinstance(config, Mapping) or TARGET not in config:
        raise UserError(f"{key}={config}: is not a part that can be used; choose one, see `ipe-bench list`")
    return _checked(construct(config, key), key, kind)


def _checked(part: Any, key: str, kind: type[Part]) -> Part:
    """The part, where it is of the kind that belongs there and can be stored and sent to other processes."""
    if not isinstance(part, kind):
        name = type(part).__name__
        raise UserError(f"{key}: {name} is not a {kind.__name__.lower()}; choose one, see `ipe-bench list`")
    try:
        canonical_json(describe(part))
        cloudpickle.dumps(part)
    except Exception as error:  # whatever a field's own methods raise
        raise UserError(
            f"{key}: a field of {type(part).__name__} can be neither stored nor sent to a worker "
            f"({describe_exception(error)}); use numbers, texts, lists and components"
        ) from None
    return part


def _refuse_false_name(label: str, target: Any) -> None:
    """Refuses to table one estimator under the name of another."""
    for group in plugins.ESTIMATOR_GROUPS:
        for option in plugins.options(group):
            if option.label == label and option.target != str(target):
                raise UserError(
                    f"estimators.{label}: is {target}, under the name of {group}={label}; choose another label"
                )


def explain(error: BaseException) -> UserError:
    """An error of Hydra, OmegaConf or YAML while composing, as one line with the remedy."""
    import yaml

    if isinstance(error, UserError):
        return error
    if isinstance(error, yaml.YAMLError):
        return UserError(plugins.explain_yaml(error))
    if isinstance(error, UnicodeDecodeError):
        return UserError(f"a config file is not UTF-8 ({error.reason}); `ipe-bench list` names it")
    text = "\n".join(str(e) for e in (error, error.__cause__) if e is not None)
    for pattern, explained in _EXPLAINED:
        found = re.search(pattern, text)
        if found:
            return UserError(explained(*found.groups()))
    full_key = re.search(r"full_key: (\S+)", text)
    lines = dict.fromkeys(line.strip() for line in text.splitlines() if line.strip())
    kept = [line for line in lines if not line.startswith(("object_type=", "full_key:", "reference_type=", "See "))]
    return UserError(f"{full_key.group(1) + ': ' if full_key else ''}{' '.join(kept) or describe_exception(error)}")


def _no_such_option(name: str) -> str:
    group, _, option = name.rpartition("/") if name.startswith("hydra/") else name.partition("/")
    known = [o.name for o in plugins.options(group)]
    if group in ("hydra/launcher", "hydra/sweeper"):
        kind = group.partition("/")[2]
        return f"{group}={option}: this {kind} is not installed; pip install hydra-{option}-{kind}, or choose basic"
    return f"{group}={option}: {unknown(option, known, 'option')}"


def _no_such_key(name: str) -> str:
    key = name.split(".")[0]
    if key == "experiment":
        return "experiment: is added, not overridden; write +experiment=NAME"
    known = {*KEYS, *plugins.groups()}
    if key in known or key == "hydra":
        return f"{name}: there is no such key; see `ipe-bench run --cfg job` for those there are"
    return f"{name}: {unknown(key, known, 'key')}"


def _invalid(word: str, value: str, choices: str) -> str:
    return f"{word}: {value} cannot be chosen (there are: {choices})"


def _wrong_type(value: str, kind: str, key: str) -> str:
    kinds = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false"}
    return f"{key}={value}: give {kinds.get(kind, kind)}"


_EXPLAINED: tuple[tuple[str, Callable[..., str]], ...] = (
    (r"Could not (?:find|load) '([^']+)'", _no_such_option),
    (r"Could not override '([^']+)'", _no_such_key),
    (
        r"Could not append to config\. An item is already at '([^']+)'",
        lambda k: f"{k}: is there already; leave out the +",
    ),
    (r"Ambiguous value for argument '([^']+)'", lambda word: f"{word}: is a sweep; add -m, or put a list in brackets"),
    (r"Error merging override (\S+)\s+Invalid value '([^']+)', expected one of \[([^]]+)\]", _invalid),
    (r"Value '(.*)' of type '[^']*' could not be converted to (\w+)[\s\S]*?full_key: (\S+)", _wrong_type),
    (
        r"Error merging override (\S+)[\s\S]*field '(\w+)' is not Optional",
        lambda word, key: f"{word}: {key} cannot be null; give it a value",
    ),
    (
        r"Interpolation key '([^']+)' not found\s+full_key: (\S+)",
        lambda k, key: f"{key}: ${{{k}}} is no key of the config",
    ),
    (
        r"Primary config[^']*'([^']+)'|Cannot find primary config '([^']+)'",
        lambda *n: f"there is no config {n[0] or n[1]}",
    ),
    (r"Missing mandatory value: \S+[\s\S]*full_key: (\S+)", lambda key: f"{key}: is not given; give it a value"),
)
