"""From config to components: `_target_` names the class, the other keys are its fields.

A component is a frozen dataclass: its fields are its config and its identity. Only classes of registered packages are
constructed, and nothing read back from results ever is.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from typing import Any

from ipe_bench.basics.errors import UserError, did_you_mean, place_of, unknown
from ipe_bench.basics.options import checked, option_types
from ipe_bench.measurements.known import ParameterInfo
from ipe_bench.runs.provenance import TARGET

_registered_packages: set[str] = {"ipe_bench"}


def register_package(name: str) -> None:
    """Lets components of that top-level package be constructed from configs."""
    _registered_packages.add(name)


def construct(config: Any, where: str) -> Any:
    """The component that a config describes; `where` is the config key, for messages."""
    if isinstance(config, list | tuple):
        return tuple(construct(v, f"{where}[{i}]") for i, v in enumerate(config))
    if not isinstance(config, Mapping):
        return config
    options = {str(k): construct(v, f"{where}.{k}") for k, v in config.items() if k != TARGET}
    return instantiate(find_class(config[TARGET], where), options, where) if TARGET in config else options


def find_class(target: Any, where: str) -> type:
    """The component class of that dotted name."""
    cls = find_object(target, where)
    where = f"{where}.{TARGET}={target}"
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise UserError(f"{where}: is not a component (a component is a frozen dataclass)")
    if missing := sorted(getattr(cls, "__abstractmethods__", ())):
        raise UserError(f"{where}: is abstract; choose a class that writes {', '.join(missing)}")
    return cls


def find_object(target: Any, where: str) -> Any:
    """What has that dotted name in a registered package."""
    where = f"{where}.{TARGET}={target}"
    module_name, _, name = str(target).rpartition(".")
    if module_name.split(".")[0] not in _registered_packages:
        known = ", ".join(sorted(_registered_packages))
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
    """What is known of each parameter, by name: {"k": {"fixed": 2.0}} fixes k."""
    found = []
    for name, options in parameters.items():
        where = f"parameters.{name}"
        if not isinstance(options, Mapping):
            raise UserError(f"{where}={options}: say what that is, such as {where}.fixed={options}")
        found.append(instantiate(ParameterInfo, {"name": str(name), **options}, where))
    return tuple(found)


def instantiate(cls: type, options: Mapping[str, Any], where: str) -> Any:
    """A dataclass with these options; the key `where` stands before their names in messages, unless it is empty."""
    prefix = f"{where}." if where else ""
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    for name in options:
        if name not in fields:
            raise UserError(f"{prefix}{name}: {unknown(name, fields, 'option')}")
    required = [f.name for f in fields.values() if f.default is f.default_factory and f.name not in options]
    try:
        # A class of a plugin need not be a `Component`, nor call its `__post_init__`.
        types = option_types(cls)
        options = {name: checked(value, types[name], name) for name, value in options.items()}
        if required:
            raise UserError(f"{required[0]}: is not given; give it a value")
        return cls(**options)
    except UserError as error:
        raise UserError(f"{prefix}{error}") from None
    except KeyboardInterrupt:
        raise
    except ValueError as error:  # how classes that know nothing of ours refuse an option
        raise UserError(f"{where}: {' '.join(str(error).split())}") from error
    except BaseException as error:
        if cls.__module__.startswith("ipe_bench."):
            raise
        raise UserError(f"{where}: {cls.__name__} cannot be made: {place_of(error)}") from None
