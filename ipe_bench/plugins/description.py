"""What a component may be told: its options with their types, values and meanings, read from its class and config."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from typing import Any

from ipe_bench.basics.options import describe_type, option_types
from ipe_bench.plugins.construct import find_class
from ipe_bench.plugins.discovery import RECORD_GROUPS, Option
from ipe_bench.runs.provenance import TARGET


@dataclass(frozen=True)
class Described:
    """One option of a component."""

    name: str
    default: Any
    """What it is set to; `MISSING` where it must be given."""
    hint: Any
    """Its type with its constraints; None where it is not known."""
    meaning: str
    """The docstring of its field, or the comment behind it in the config."""

    @property
    def value(self) -> str:
        """The default as a config writes it."""
        return "" if self.default is MISSING else written(self.default)

    @property
    def kind(self) -> str:
        """What may be given, in words."""
        return "" if self.hint in (None, Any) else describe_type(self.hint)


def described(option: Option) -> list[Described]:
    """The options of what a config file names, in the order of its class."""
    config: Mapping[str, Any] = option.config or {}
    if option.group in RECORD_GROUPS:
        return []
    if option.target is None:
        return [Described(str(key), value, None, "") for key, value in config.items() if key != "defaults"]
    return options_of(find_class(option.target, f"{option.group}.{option.name}"), config, option.comments)


def options_of(cls: type, config: Mapping[str, Any], comments: Mapping[str, str]) -> list[Described]:
    """The options of a dataclass; what `config` says of one stands in place of its default, and what `comments` say
    where the class does not say what is meant."""
    kinds, texts = option_types(cls), {**comments, **meanings(cls)}
    found = []
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        if field.init:
            default = field.default if field.default_factory is MISSING else field.default_factory()
            value = config.get(field.name, default)
            found.append(Described(field.name, value, kinds[field.name], texts.get(field.name, "")))
    return found


def written(value: Any) -> str:
    """A value as one writes it on the command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    if isinstance(value, tuple | list):
        return f"[{','.join(map(written, value))}]"
    if isinstance(value, Mapping):
        inner = ", ".join(f"{k}: {written(v)}" for k, v in value.items() if k != TARGET)
        return f"{{{inner}}}"
    return "" if value == "???" else type(value).__name__ if dataclasses.is_dataclass(value) else str(value)


def meanings(cls: type) -> dict[str, str]:
    """By field, the text below it, of the class and its bases."""
    found: dict[str, str] = {}
    for base in (base for base in reversed(cls.__mro__) if dataclasses.is_dataclass(base)):
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
