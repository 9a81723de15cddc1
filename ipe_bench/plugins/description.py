"""What a component may be told: its options with their types, values and meanings, read from its class and config."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ipe_bench.basics.options import describe_type, option_types
from ipe_bench.plugins.construct import find_class
from ipe_bench.plugins.discovery import RECORD_GROUPS, Option
from ipe_bench.runs.provenance import TARGET


@dataclass(frozen=True)
class Described:
    """One option of a component."""

    name: str
    value: str
    """What it is set to, as a config writes it; empty where it must be given."""
    kind: str
    """What may be given, in words."""
    meaning: str
    """The docstring of its field, or the comment behind it in the config."""


def described(option: Option) -> list[Described]:
    """The options of what a config file names, in the order of its class.

    Raises:
        UserError: the class is not there, or cannot be imported.
    """
    config: Mapping[str, Any] = option.config or {}
    if option.group in RECORD_GROUPS:
        return []
    if option.target is None:
        return [Described(str(key), _written(value), "", "") for key, value in config.items() if key != "defaults"]
    cls = find_class(option.target, f"{option.group}.{option.name}")
    kinds, texts, comments = option_types(cls), meanings(cls), option.comments
    return [
        Described(
            field.name,
            _value(field, config),
            describe_type(kinds[field.name]),
            texts.get(field.name) or comments.get(field.name, ""),
        )
        for field in dataclasses.fields(cls)
        if field.init
    ]


def _value(field: dataclasses.Field[Any], config: Mapping[str, Any]) -> str:
    if field.name in config:
        return _written(config[field.name])
    if field.default is not dataclasses.MISSING:
        return _written(field.default)
    return "" if field.default_factory is dataclasses.MISSING else _written(field.default_factory())


def _written(value: Any) -> str:
    """A value as one writes it on the command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    if isinstance(value, tuple | list):
        return f"[{','.join(map(_written, value))}]"
    if isinstance(value, Mapping):
        inner = ", ".join(f"{k}: {_written(v)}" for k, v in value.items() if k != TARGET)
        return f"{{{inner}}}"
    return "" if value == "???" else type(value).__name__ if dataclasses.is_dataclass(value) else str(value)


def meanings(cls: type) -> dict[str, str]:
    """By field, the text below it, of the class and its bases."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        except (OSError, TypeError, SyntaxError, IndexError):
            continue
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            match field, text:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(value=str(words))):
                    found[name] = " ".join(words.split())
    return found
