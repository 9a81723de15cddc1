"""JSON schemas of configs, from the types of the classes that they name: for editors that complete and check YAML.

What a schema cannot say, such as that two options suit one another, is left to the classes.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.options import bounds_of
from ipe_bench.plugins.construct import find_class
from ipe_bench.plugins.description import Described, described
from ipe_bench.plugins.discovery import COMPONENT_GROUPS, ESTIMATOR_GROUPS, RECORD_GROUPS, Option
from ipe_bench.runs.provenance import TARGET

Schema = dict[str, Any]
INTERPOLATION: Schema = {"type": "string", "pattern": r"\$\{.+\}"}
"""A value that is taken from another key."""
YET_TO_BE_GIVEN: Schema = {"const": "???"}
_DEFINED = "#/$defs/"
_PLAIN = {int: "integer", float: "number", bool: "boolean", str: "string", type(None): "null"}
_LIMITS = {Gt: ("gt", "exclusiveMinimum"), Ge: ("ge", "minimum"), Lt: ("lt", "exclusiveMaximum"), Le: ("le", "maximum")}
_LENGTHS = {MinLen: ("min_length", "min"), MaxLen: ("max_length", "max")}


def type_schema(hint: Any) -> Schema:
    """What values of a type look like in JSON; the empty schema where nothing can be said."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        inner = type_schema(arguments[0])
        return inner | _limits(arguments[1:], "Length" if inner.get("type") == "string" else "Items")
    if origin in (typing.Union, types.UnionType):
        return {"anyOf": [type_schema(part) for part in arguments]}
    if origin is typing.Literal:
        return {"enum": list(arguments)}
    if origin is tuple:
        return _list_schema(arguments)
    if hint in _PLAIN:
        return {"type": _PLAIN[hint]}
    plain = origin or hint
    if isinstance(plain, type) and issubclass(plain, Mapping):
        return {"type": "object"}  # what stands under which key is the class's business
    return {"type": "object", "required": [TARGET]} if dataclasses.is_dataclass(plain) else {}


def _list_schema(arguments: Sequence[Any]) -> Schema:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return {"type": "array", "items": type_schema(arguments[0])}
    entries = [type_schema(part) for part in arguments]
    return {"type": "array", "prefixItems": entries, "minItems": len(entries), "maxItems": len(entries)}


def _limits(metadata: Iterable[Any], counted: str) -> Schema:
    """The constraints of an annotation in the words of JSON schemas; a predicate cannot be said in them."""
    found: Schema = {}
    for bound in bounds_of(metadata):
        if type(bound) in _LIMITS:
            attribute, word = _LIMITS[type(bound)]
            found[word] = getattr(bound, attribute)
        elif type(bound) in _LENGTHS:
            attribute, word = _LENGTHS[type(bound)]
            found[f"{word}{counted}"] = getattr(bound, attribute)
    return found


def option_schema(one: Described) -> Schema:
    """One option with its title, type, limits, meaning and default; or what is taken from another key."""
    meaning = one.meaning[:1].upper() + one.meaning[1:].rstrip(".")
    words = " ".join(f"{part}." for part in (meaning, one.kind and f"Give {one.kind}") if part)
    value = type_schema(one.hint)
    allowed = value["anyOf"] if set(value) == {"anyOf"} else [value]
    checked = {"anyOf": [*allowed, INTERPOLATION, YET_TO_BE_GIVEN]} if value else {}
    plain = isinstance(one.default, bool | int | float | str | list | tuple | dict | type(None))
    default = list(one.default) if isinstance(one.default, tuple) else one.default
    given = {"default": default} if plain and default != "???" else {}
    return {"title": one.name, "description": words, **given, **checked}


def component_schema(option: Option) -> Schema:
    """What the file of an option may hold: the options of the class that it names, and nothing else.

    Raises:
        UserError: the class is not there, or cannot be imported.
    """
    assert option.target is not None
    names = [option.target]
    if option.group not in RECORD_GROUPS:
        cls = find_class(option.target, f"{option.group}.{option.name}")
        names = list(dict.fromkeys((option.target, f"{cls.__module__}.{cls.__qualname__}")))
    target = {"title": TARGET, "description": "The class.", "enum": names}
    return {
        "title": option.name,
        "description": option.summary,
        "type": "object",
        "properties": {TARGET: target, **{one.name: option_schema(one) for one in described(option)}},
        "additionalProperties": False,
    }


def name_of(option: Option) -> str:
    """What an option is called among the definitions of a schema, where a slash would have a meaning."""
    return f"{option.group}.{option.name.replace('/', '.')}"


def schema_of(options: Sequence[Option], keys: Iterable[Described]) -> tuple[Schema, list[str]]:
    """One schema for every file, and why some options have none, a line each: what names a class has the options of
    that class, all else is an experiment, which has the `keys` of a run."""
    parts: dict[str, Schema] = {}
    problems = []
    for option in options:
        if option.group in (*COMPONENT_GROUPS, *RECORD_GROUPS) and option.target is not None:
            try:
                if option.fault is not None:
                    raise UserError(option.fault)
                parts[name_of(option)] = component_schema(option)
            except UserError as error:
                problems.append(f"{option.group}/{option.name}: has no schema: {error}")
    known = [option for option in options if name_of(option) in parts]
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Configs of ipe-bench",
        "type": "object",
        "if": {"required": [TARGET]},
        "then": _of_components(parts),
        "else": {"$ref": f"{_DEFINED}experiment"},
        "$defs": {**parts, "experiment": _of_experiments(known, options, keys)},
    }
    return schema, problems


def _of_components(parts: dict[str, Schema]) -> Schema:
    """The schema of the class that a file names; a class that is not known here may have any options."""
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


def _of_experiments(known: Sequence[Option], options: Sequence[Option], keys: Iterable[Described]) -> Schema:
    """A file that chooses, and sets keys of what it chooses."""
    groups = [group for group in COMPONENT_GROUPS if group not in ESTIMATOR_GROUPS]
    estimators = {o.label: {"$ref": _DEFINED + name_of(o)} for o in known if o.group in ESTIMATOR_GROUPS}
    properties: Schema = {"defaults": _of_defaults(options), "hydra": {"type": "object"}}
    properties |= {one.name: option_schema(one) for one in keys}
    properties |= {group: {"title": group, "type": "object"} for group in groups}
    properties["estimators"] = {"type": "object", "properties": estimators, "additionalProperties": {"type": "object"}}
    return {
        "title": "experiment",
        "description": "Chooses one option of each group, and sets keys.",
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        "allOf": [_where_chosen(option) for option in known if option.group in groups],
    }


def _of_defaults(options: Sequence[Option]) -> Schema:
    names: dict[str, list[str]] = {}
    for option in options:
        if option.fault is None:
            names.setdefault(option.group, []).append(option.name)
    choices: dict[str, Schema] = {}
    for group, known in names.items():
        several = group in ESTIMATOR_GROUPS
        chosen = {"type": "array", "items": {"enum": known}} if several else {"enum": [*known, None]}
        choices |= {f"{sign}{group}": chosen for sign in ("override /", "/", "")}
    pattern = rf"^(override )?/?(hydra/.+|({'|'.join(names)})(@.+)?)$"
    entry = {"type": "object", "properties": choices, "propertyNames": {"pattern": pattern}}
    return {"title": "defaults", "type": "array", "items": {"anyOf": [entry, {"type": "string"}]}}


def _where_chosen(option: Option) -> Schema:
    """Where the file chooses that option, its keys are those of the option's class."""
    chosen = [
        {"required": [key], "properties": {key: {"const": option.name}}}
        for key in (f"override /{option.group}", f"/{option.group}")
    ]
    chooses = {"required": ["defaults"], "properties": {"defaults": {"contains": {"anyOf": chosen}}}}
    return {"if": chooses, "then": {"properties": {option.group: {"$ref": _DEFINED + name_of(option)}}}}
