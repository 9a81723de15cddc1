"""Constructs components from config, and describes their options: `_target_` names the class, the
other keys are its fields. Only classes of registered packages are constructed."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import json
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from typing import Any

from ipe_bench.basics.errors import (
    UserError,
    did_you_mean,
    moved,
    place_of,
    refuse_unknown,
)
from ipe_bench.basics.options import checked, describe_type, option_types
from ipe_bench.measurements.known import ParameterInfo
from ipe_bench.plugins import discovery
from ipe_bench.runs.provenance import TARGET


def construct(config: Any, where: str) -> Any:
    """Constructs the component that a config describes; `where` is the config key, for messages."""
    if isinstance(config, list | tuple):
        return tuple(construct(v, f"{where}[{i}]") for i, v in enumerate(config))
    if not isinstance(config, Mapping):
        return config
    options = {str(k): construct(v, f"{where}.{k}") for k, v in config.items() if k != TARGET}
    if TARGET not in config:
        return options
    return instantiate(find_class(config[TARGET], where), options, where)


def find_class(target: Any, where: str) -> type:
    """Finds the component class of that dotted name."""
    cls = find_object(target, where)
    where = f"{where}.{TARGET}={target}"
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise UserError(f"{where}: is not a component (a component is a frozen dataclass)")
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    if missing:
        raise UserError(f"{where}: is abstract; choose a class that writes {', '.join(missing)}")
    return cls


def find_object(target: Any, where: str) -> Any:
    """Finds the object of that dotted name in a registered package."""
    where = f"{where}.{TARGET}={target}"
    module_name, _, name = str(target).rpartition(".")
    place = moved(name)
    if place and module_name.startswith("ipe_bench."):
        raise UserError(f"{where}: {place}")
    if module_name.split(".")[0] not in discovery.packages:
        known = ", ".join(sorted(discovery.packages))
        raise UserError(f"{where}: only classes of these packages are constructed: {known}")
    try:
        module = importlib.import_module(module_name)
        if hasattr(module, name):
            return getattr(module, name)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(module_name.split(".")[0]):
            raise UserError(f"{where}: {error.msg.splitlines()[0]}") from None
        raise UserError(f"{where}: {place_of(error)}; install what the plugin needs") from None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a plugin may do anything while it is imported, sys.exit() too
        if module_name.startswith("ipe_bench."):
            raise
        raise UserError(f"{where}: its module cannot be imported: {place_of(error)}") from None
    raise UserError(f"{where}: {module_name} has no {name}{did_you_mean(name, dir(module))}")


def known_parameters(parameters: Mapping[str, Any]) -> tuple[ParameterInfo, ...]:
    """Reads what is known of each parameter, by name: {"k": {"fixed": 2.0}} fixes k."""
    found = []
    for name, options in parameters.items():
        where = f"parameters.{name}"
        if not isinstance(options, Mapping):
            raise UserError(
                f"{where}={options}: state what that is, such as {where}.fixed={options}"
            )
        found.append(instantiate(ParameterInfo, {"name": str(name), **options}, where))
    return tuple(found)


def instantiate(cls: type, options: Mapping[str, Any], where: str) -> Any:
    """Constructs a dataclass with these options; the key `where` stands before their names in
    messages if not empty."""
    prefix = f"{where}." if where else ""
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    for name in options:
        refuse_unknown(f"{prefix}{name}", name, fields, "option")
    bare = [f.name for f in fields.values() if f.default is f.default_factory]
    required = [name for name in bare if name not in options]
    try:
        # A class of a plugin need not be a `Component`, nor call its `__post_init__`.
        types = option_types(cls)
        options = {name: checked(value, types[name], name) for name, value in options.items()}
        if required:
            raise UserError(f"{required[0]}: is required")
        return cls(**options)
    except UserError as error:
        # A class whose check is made later, too, names the whole key itself.
        raise UserError(f"{prefix}{str(error).removeprefix(prefix)}") from None
    except ValueError as error:  # how classes that know nothing of ours refuse an option
        raise UserError(f"{where}: {' '.join(str(error).split())}") from error
    except (Exception, SystemExit) as error:
        if cls.__module__.startswith("ipe_bench."):
            raise
        raise UserError(f"{where}: {cls.__name__} cannot be made: {place_of(error)}") from None


@dataclass(frozen=True)
class Described:
    """Describes one option of a component."""

    name: str
    value: str
    """Value of the option in a config; empty where it must be given."""
    kind: str
    """Type of the value."""
    meaning: str
    """The docstring of its field, or the comment behind it in the config."""


def described(option: discovery.Option) -> list[Described]:
    """Describes the options of what a config file names, in the order of its class."""
    config = option.config or {}
    if option.group in discovery.RECORD_GROUPS:
        return []
    if option.target is None:
        return [
            Described(str(key), _written(value), "", "")
            for key, value in config.items()
            if key != "defaults"
        ]
    cls = find_class(option.target, f"{option.group}.{option.name}")
    kinds = option_types(cls)
    texts = {**option.comments, **_meanings(cls)}
    found = []
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        default = field.default if field.default_factory is MISSING else field.default_factory()
        hint = kinds[field.name]
        kind = "" if hint is Any else describe_type(hint)
        value = _written(config.get(field.name, default))
        found.append(Described(field.name, value, kind, texts.get(field.name, "")))
    return found


def _written(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    if isinstance(value, tuple | list):
        return f"[{','.join(map(_written, value))}]"
    if isinstance(value, Mapping):
        entries = [f"{key}: {_written(one)}" for key, one in value.items() if key != TARGET]
        return f"{{{', '.join(entries)}}}"
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    if value is MISSING or value == "???":
        return ""
    return str(value)


def _meanings(cls: type) -> dict[str, str]:
    """Collects the text below each field, of the class and its bases."""
    found: dict[str, str] = {}
    for base in (base for base in reversed(cls.__mro__) if dataclasses.is_dataclass(base)):
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            match field, text:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(
                    value=ast.Constant(value=str(words))
                ):
                    found[name] = " ".join(words.split())
    return found
