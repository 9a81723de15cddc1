"""From config to components: `_target_` names the class, the other keys are its fields.

A component is a frozen dataclass: its fields are its config and its identity. Only classes of registered packages are
constructed, and nothing read back from results ever is.
"""

from __future__ import annotations

import dataclasses
import importlib
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.runs.provenance import TARGET

_registered_packages: set[str] = {"ipe_bench"}


def register_package(name: str) -> None:
    """Lets components of that top-level package be constructed from configs."""
    _registered_packages.add(name)


def construct(config: Any, where: str) -> Any:
    """The component that a config describes: `_target_` names the class, the other keys are its fields.

    `where` is the config key, for messages.

    Raises:
        UserError: an unknown class or option, or a value of the wrong type, by its key.
    """
    if isinstance(config, Mapping):
        if TARGET not in config:
            return {str(k): construct(v, f"{where}.{k}") for k, v in config.items()}
        cls = _find_class(config[TARGET], where)
        options = {str(k): construct(v, f"{where}.{k}") for k, v in config.items() if k != TARGET}
        return _instantiate(cls, options, where)
    if isinstance(config, list | tuple):
        return tuple(construct(v, f"{where}[{i}]") for i, v in enumerate(config))
    return config


def _find_class(target: Any, where: str) -> type:
    module_name, _, class_name = str(target).rpartition(".")
    if module_name.split(".")[0] not in _registered_packages:
        known = ", ".join(sorted(_registered_packages))
        raise UserError(f"{where}.{TARGET}={target}: only classes of these packages are constructed: {known}")
    try:
        cls = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError) as error:
        raise UserError(f"{where}.{TARGET}={target}: {error}") from None
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise UserError(f"{where}.{TARGET}={target}: is no component (a component is a frozen dataclass)")
    return cls


def _instantiate(cls: type, options: dict[str, Any], where: str) -> Any:
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    _check_options(options, fields, where)
    hints = typing.get_type_hints(cls)
    for name, value in options.items():
        options[name] = _checked(value, hints[name], f"{where}.{name}")
    required = [
        name
        for name, f in fields.items()
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING and name not in options
    ]
    if required:
        raise UserError(f"{where}.{required[0]}: is not given; give it a value")
    try:
        return cls(**options)
    except UserError as error:
        raise UserError(f"{where}.{error}") from None


def _check_options(options: Iterable[str], known: Iterable[str], where: str) -> None:
    for name in options:
        if name not in known:
            raise UserError(f"{where}.{name}: {unknown(name, known, 'option')}")


def _checked(value: Any, hint: Any, where: str) -> Any:
    """The value, converted where the type allows (1 for 1.0), else a UserError."""
    if hint is Any or isinstance(hint, typing.TypeVar):
        return value
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        for argument in arguments:
            try:
                return _checked(value, argument, where)
            except UserError:
                continue
        raise UserError(f"{where}={value}: give {_describe_type(hint)}")
    if origin is typing.Literal:
        if value not in arguments:
            raise UserError(f"{where}={value}: choose {' or '.join(map(str, arguments))}")
        return value
    if origin is tuple and isinstance(value, tuple):
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_checked(v, arguments[0], f"{where}[{i}]") for i, v in enumerate(value))
        if len(arguments) == len(value):
            return tuple(_checked(v, a, f"{where}[{i}]") for i, (v, a) in enumerate(zip(value, arguments, strict=True)))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    plain = origin or hint
    if isinstance(plain, type) and isinstance(value, plain) and not (plain in (int, float) and isinstance(value, bool)):
        return value
    raise UserError(f"{where}={value}: give {_describe_type(hint)}")


def _describe_type(hint: Any) -> str:
    names = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", type(None): "null"}
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(_describe_type(a) for a in arguments)
    if typing.get_origin(hint) is tuple:
        return "a list"
    return names.get(hint, getattr(hint, "__name__", str(hint)))
