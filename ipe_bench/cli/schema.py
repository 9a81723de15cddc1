"""`ipe-bench schema`: a JSON schema of config files, with which editors complete and check what is written there."""

from __future__ import annotations

import json
import sys
from typing import Any

from ipe_bench.cli.spec import DEFAULTS, KINDS, Spec
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.description import meanings
from ipe_bench.plugins.schema import DIALECT, Schema, components, name_of, option_schema
from ipe_bench.runs.provenance import TARGET

_DEFINED = "#/$defs/"


def main() -> int:
    """Prints the schema of the files of all options that there are here, and of experiments."""
    for problem in plugins.take_problems():
        print(f"ipe-bench: {problem}", file=sys.stderr)
    schema, problems = of_all(plugins.options())
    for problem in problems:
        print(f"ipe-bench: {problem}", file=sys.stderr)
    print(json.dumps(schema, indent=2, ensure_ascii=False))
    return 0


def of_all(options: list[plugins.Option]) -> tuple[Schema, list[str]]:
    """One schema for every file: what names a class has the options of that class, all else is an experiment."""
    parts, problems = components(options)
    known = [option for option in options if name_of(option) in parts]
    schema = {
        "$schema": DIALECT,
        "title": "Configs of ipe-bench",
        "type": "object",
        "if": {"required": [TARGET]},
        "then": _of_components(parts),
        "else": {"$ref": f"{_DEFINED}experiment"},
        "$defs": {**parts, "experiment": _of_experiments(known, options)},
    }
    return schema, problems


def _of_components(parts: dict[str, Schema]) -> Schema:
    """The schema of the class that a file names; a class of nobody that is known here may have any options."""
    by_class: dict[tuple[str, ...], str] = {}
    for name, part in parts.items():
        by_class.setdefault(tuple(part["properties"][TARGET]["enum"]), name)
    choices = [
        {"if": {"properties": {TARGET: {"enum": list(names)}}}, "then": {"$ref": _DEFINED + name}}
        for names, name in by_class.items()
    ]
    every = [name for names in by_class for name in names]
    target = {"anyOf": [{"enum": every}, {"type": "string", "pattern": r"^(?!ipe_bench\.)[\w.]+$"}]}
    return {"properties": {TARGET: target}, "allOf": choices}


def _of_experiments(known: list[plugins.Option], options: list[plugins.Option]) -> Schema:
    """A file that chooses, and sets keys of what it chooses."""
    estimators = {o.label: {"$ref": _DEFINED + name_of(o)} for o in known if o.group in plugins.ESTIMATOR_GROUPS}
    groups = [g for g in plugins.COMPONENT_GROUPS if g not in plugins.ESTIMATOR_GROUPS]
    keys = _keys()
    keys["estimators"] |= {"properties": estimators, "additionalProperties": {"type": "object"}}
    keys |= {group: {"title": group, "type": "object"} for group in groups}
    return {
        "title": "experiment",
        "description": "Chooses one option of each group, and sets keys.",
        "type": "object",
        "properties": {"defaults": _of_defaults(options), "hydra": {"type": "object"}, **keys},
        "additionalProperties": False,
        "allOf": [_where_chosen(option) for option in known if option.group in groups],
    }


def _keys() -> dict[str, Schema]:
    texts = meanings(Spec)
    found = {
        name: option_schema(kind, name, texts.get(name, ""), **_default(DEFAULTS[name])) for name, kind in KINDS.items()
    }
    return {**found, "estimators": {"title": "estimators", "type": "object"}}


def _default(value: Any) -> dict[str, Any]:
    return {"default": value} if isinstance(value, int | float | str | type(None)) and value != "???" else {}


def _of_defaults(options: list[plugins.Option]) -> Schema:
    names: dict[str, list[str]] = {}
    for option in options:
        if option.fault is None:
            names.setdefault(option.group, []).append(option.name)
    choices: dict[str, Schema] = {}
    for group, known in names.items():
        chosen: Schema = {"enum": [*known, None]}
        if group in plugins.ESTIMATOR_GROUPS:
            chosen = {"type": "array", "items": {"enum": known}}
        choices |= {f"{sign}{group}": chosen for sign in ("override /", "/", "")}
    pattern = rf"^(override )?/?(hydra/.+|({'|'.join(names)})(@.+)?)$"
    entry = {"type": "object", "properties": choices, "propertyNames": {"pattern": pattern}}
    return {"title": "defaults", "type": "array", "items": {"anyOf": [entry, {"type": "string"}]}}


def _where_chosen(option: plugins.Option) -> Schema:
    """Where the file chooses that option, its keys are those of the option's class."""
    chosen = [
        {"required": [key], "properties": {key: {"const": option.name}}}
        for key in (f"override /{option.group}", f"/{option.group}")
    ]
    chooses = {"required": ["defaults"], "properties": {"defaults": {"contains": {"anyOf": chosen}}}}
    return {"if": chooses, "then": {"properties": {option.group: {"$ref": _DEFINED + name_of(option)}}}}
