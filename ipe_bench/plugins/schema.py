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
from ipe_bench.basics.options import bounds_of, describe_type, option_types
from ipe_bench.plugins.construct import find_class
from ipe_bench.plugins.description import meanings
from ipe_bench.plugins.discovery import COMPONENT_GROUPS, RECORD_GROUPS, Option
from ipe_bench.runs.provenance import TARGET

Schema = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
INTERPOLATION: Schema = {"type": "string", "pattern": r"\$\{.+\}"}
"""A value that is taken from another key."""
MISSING: Schema = {"const": "???"}
"""A value that has yet to be given."""
_PLAIN: dict[Any, Schema] = {
    int: {"type": "integer"},
    float: {"type": "number"},
    bool: {"type": "boolean"},
    str: {"type": "string"},
    type(None): {"type": "null"},
    Any: {},
}


def type_schema(hint: Any) -> Schema:
    """What values of a type look like in JSON; the empty schema where nothing can be said."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        inner = type_schema(arguments[0])
        return inner | _limits(arguments[1:], inner.get("type", ""))
    if origin in (typing.Union, types.UnionType):
        return {"anyOf": [type_schema(part) for part in arguments]}
    if origin is typing.Literal:
        return {"enum": list(arguments)}
    if origin is tuple:
        return _list_schema(arguments)
    if hint in _PLAIN:
        return dict(_PLAIN[hint])
    plain = origin or hint
    if isinstance(plain, type) and issubclass(plain, Mapping):
        return {"type": "object"}  # what stands under which key is the class's business
    if dataclasses.is_dataclass(plain):
        return {"type": "object", "required": [TARGET]}
    return {}


def _list_schema(arguments: Sequence[Any]) -> Schema:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return {"type": "array", "items": type_schema(arguments[0])}
    entries = [type_schema(part) for part in arguments]
    return {"type": "array", "prefixItems": entries, "minItems": len(entries), "maxItems": len(entries)}


def _limits(metadata: Iterable[Any], kind: Any) -> Schema:
    """The constraints of an annotation in the words of JSON schemas; a predicate cannot be said in them."""
    found: Schema = {}
    length = "Length" if kind == "string" else "Items"
    for bound in bounds_of(metadata):
        match bound:
            case Gt(limit):
                found["exclusiveMinimum"] = limit
            case Ge(limit):
                found["minimum"] = limit
            case Lt(limit):
                found["exclusiveMaximum"] = limit
            case Le(limit):
                found["maximum"] = limit
            case MinLen(limit):
                found[f"min{length}"] = limit
            case MaxLen(limit):
                found[f"max{length}"] = limit
    return found


def option_schema(hint: Any, title: str, meaning: str = "", **default: Any) -> Schema:
    """One option with its title, type, limits, meaning and default; or what is taken from another key."""
    words = " ".join(part for part in (f"{_capital(meaning.rstrip('.'))}." if meaning else "", _given(hint)) if part)
    value = type_schema(hint)
    allowed = value["anyOf"] if set(value) == {"anyOf"} else [value]
    checked = {"anyOf": [*allowed, INTERPOLATION, MISSING]} if value else {}
    return {"title": title, "description": words, **default, **checked}


def _given(hint: Any) -> str:
    return "" if hint is Any else f"Give {describe_type(hint)}."


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def component_schema(option: Option) -> Schema:
    """What the file of an option may hold: the options of the class that it names, and nothing else.

    Raises:
        UserError: the class is not there, or cannot be imported.
    """
    options = {} if option.group in RECORD_GROUPS else _options(option)
    target = {"title": TARGET, "description": "The class.", "enum": names_of(option)}
    return {
        "title": option.name,
        "description": option.summary,
        "type": "object",
        "properties": {TARGET: target, **options},
        "additionalProperties": False,
    }


def name_of(option: Option) -> str:
    """What an option is called among the definitions of a schema, where a slash would have a meaning."""
    return f"{option.group}.{option.name.replace('/', '.')}"


def names_of(option: Option) -> list[str]:
    """The dotted names under which a config may name the class, or the record, of an option."""
    assert option.target is not None
    if option.group in RECORD_GROUPS:
        return [option.target]
    cls = find_class(option.target, f"{option.group}.{option.name}")
    return list(dict.fromkeys((option.target, f"{cls.__module__}.{cls.__qualname__}")))


def _options(option: Option) -> dict[str, Schema]:
    """By key, each option of the class; the default is the file's, else the class's."""
    assert option.target is not None
    cls = find_class(option.target, f"{option.group}.{option.name}")
    config: Mapping[str, Any] = option.config or {}
    texts, comments = meanings(cls), option.comments
    return {
        field.name: option_schema(
            hint,
            field.name,
            texts.get(field.name) or comments.get(field.name, ""),
            **_default(field, config),
        )
        for field, hint in _fields(cls)
    }


def _fields(cls: Any) -> list[tuple[dataclasses.Field[Any], Any]]:
    hints = option_types(cls)
    return [(field, hints[field.name]) for field in dataclasses.fields(cls) if field.init]


def _default(field: dataclasses.Field[Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """The default where it can be written as JSON."""
    value = config.get(field.name, field.default)
    if value is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    plain = isinstance(value, bool | int | float | str | list | tuple | dict | type(None))
    return {} if value == "???" or not plain else {"default": list(value) if isinstance(value, tuple) else value}


def components(options: Iterable[Option]) -> tuple[dict[str, Schema], list[str]]:
    """By `name_of`, the schema of the file of each option; and why some have none, a line each."""
    found: dict[str, Schema] = {}
    problems = []
    for option in options:
        if option.group not in (*COMPONENT_GROUPS, *RECORD_GROUPS) or option.target is None:
            continue
        try:
            if option.fault is not None:
                raise UserError(option.fault)
            found[name_of(option)] = component_schema(option)
        except UserError as error:
            problems.append(f"{option.group}/{option.name}: has no schema: {error}")
    return found, problems
