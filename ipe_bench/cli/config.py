"""From the command line through Hydra to scenarios and estimators, with Hydra's silent traps closed."""

from __future__ import annotations

import fnmatch
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ipe_bench.basics.errors import UserError, describe_exception, unknown
from ipe_bench.cli.search_path import extend
from ipe_bench.cli.spec import DEFAULTS, KEYS, Spec, spec
from ipe_bench.measurements.nist import datasets
from ipe_bench.plugins import discovery as plugins
from ipe_bench.runs.provenance import TARGET

CONFIG_ERRORS = (HydraException, OmegaConfBaseException)


class PluginConfigs(SearchPathPlugin):
    """Lets our own commands find the options of plugins, those in the working folder as well."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        extend(search_path, plugins.sources())


def prepare() -> None:
    """Makes the schema and the plugins known to Hydra."""
    for problem in plugins.take_problems():
        print(f"ipe-bench: {problem}", file=sys.stderr)
    ConfigStore.instance().store("schema", node=DEFAULTS, provider="ipe-bench")
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
        content = plugins.read_yaml(Path(name).read_text(encoding="utf-8"))
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


def assemble(config: DictConfig) -> Spec:
    """The checked job of a composed config; UserError by key."""
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    return spec(plain)


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
