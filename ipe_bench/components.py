"""Components as config and config as components: constructing from a mapping, describing, and fingerprinting.

A component is a frozen dataclass: its fields are its config and its identity. Only classes of registered packages are
constructed, and nothing read back from results ever is.
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.errors import UserError
from ipe_bench.ipe import IPE
from ipe_bench.solvers.base import Solver

TARGET = "_target_"
_DRIVER_OPTIONS = frozenset(f.name for f in dataclasses.fields(IPE)) - {"solver"}

_registered_packages: set[str] = {"ipe_bench"}


def register_package(name: str) -> None:
    """Lets components of that top-level package be constructed from configs."""
    _registered_packages.add(name)


def construct(config: Any, where: str) -> Any:
    """The component that a config describes: `_target_` names the class, the other keys are its fields.

    `where` is the config key, for messages. A solver's options stand beside those of the driver (`max_iterations`,
    `tolerance`, `start`, `budget`); together they make an IPE estimator.

    Raises:
        UserError: an unknown class or option, or a value of the wrong type, by its key.
    """
    if isinstance(config, Mapping):
        if TARGET not in config:
            return {str(k): construct(v, f"{where}.{k}") for k, v in config.items()}
        cls = _find_class(config[TARGET], where)
        options = {str(k): construct(v, f"{where}.{k}") for k, v in config.items() if k != TARGET}
        if issubclass(cls, Solver) and not where.endswith(".solver"):
            known = _DRIVER_OPTIONS | {f.name for f in dataclasses.fields(cls)}  # pyright: ignore[reportArgumentType]
            _check_options(options, known, where)
            driver = {k: v for k, v in options.items() if k in _DRIVER_OPTIONS}
            own = {k: v for k, v in options.items() if k not in _DRIVER_OPTIONS}
            return _instantiate(IPE, {"solver": _instantiate(cls, own, where), **driver}, where)
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


def unknown(name: str, known: Iterable[str], noun: str) -> str:
    """'there is no such option; did you mean ...', with everything there is."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, 1)
    hint = f"; did you mean {close[0]}?" if close else ""
    return f"there is no such {noun}{hint} (there are: {', '.join(known) or 'none'})"


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


def describe(value: Any) -> Any:
    """A component as plain JSON data: its class and all its fields."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        cls = type(value)
        fields = {f.name: describe(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {TARGET: f"{cls.__module__}.{cls.__qualname__}", **fields}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return [describe(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): describe(v) for k, v in value.items()}
    return value


def leaves(description: Any, prefix: str = "") -> dict[str, Any]:
    """A description as dotted keys and plain values, classes included."""
    if isinstance(description, Mapping):
        result: dict[str, Any] = {}
        for key, value in description.items():
            result |= leaves(value, f"{prefix}.{key}" if prefix else str(key))
        return result
    if isinstance(description, list) and any(isinstance(v, Mapping | list) for v in description):
        return leaves({str(i): v for i, v in enumerate(description)}, prefix)
    return {prefix: description}


def canonical_json(value: Any) -> str:
    """One text for one value: sorted keys, no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=True)


def fingerprint(components: Iterable[Any]) -> dict[str, Any]:
    """The versions of the packages, and a digest of the numerical source, that components are made of.

    The source of a component is the module of its class with all modules of its package that it imports, so a change in
    anything that it computes with changes the digest, and a new file elsewhere does not. The scoring of trials counts
    as part of it.
    """
    modules = set(_import_closure("ipe_bench.montecarlo"))
    for component in components:
        for cls in _classes(component):
            modules |= _import_closure(cls.__module__)
    packages = sorted({m.split(".")[0] for m in modules})
    digest = hashlib.sha256()
    for module in sorted(modules):
        digest.update(module.encode())
        digest.update(_source_of(module))
        digest.update(_data_of(module))
    return {"versions": {p: package_version(p) for p in packages}, "source": digest.hexdigest()[:16]}


def class_modules(component: Any) -> set[str]:
    """The modules of the classes of a component and of the components inside it."""
    return {cls.__module__ for cls in _classes(component)}


def _classes(component: Any) -> list[type]:
    """The class of a component and of the components inside it."""
    if isinstance(component, tuple | list):
        return [cls for item in component for cls in _classes(item)]
    if not dataclasses.is_dataclass(component) or isinstance(component, type):
        return []
    inner = [cls for f in dataclasses.fields(component) for cls in _classes(getattr(component, f.name))]
    return [type(component), *inner]


@functools.cache
def package_version(package: str) -> str:
    """The version of the distribution that a top-level package comes from, where it is installed as one."""
    if package == "ipe_bench":
        from ipe_bench import __version__

        return __version__
    for distribution in importlib.metadata.packages_distributions().get(package, []):
        return importlib.metadata.version(distribution)
    return "none"


@functools.cache
def _import_closure(module: str) -> frozenset[str]:
    """The module and, recursively, what it imports from its own top-level package or from ipe_bench."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting.extend(_imports(name))
    return frozenset(found)


@functools.cache
def _imports(module: str) -> tuple[str, ...]:
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return ()
    package = module if spec.submodule_search_locations is not None else module.rpartition(".")[0]
    names: set[str] = set()
    for node in ast.walk(ast.parse(_source_of(module))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            base = importlib.util.resolve_name(base, package) if node.level else base
            names |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    own = {module.split(".")[0], "ipe_bench"}
    return tuple(sorted(n for n in names if n.split(".")[0] in own and _is_module(n)))


@functools.cache
def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


@functools.cache
def _data_of(module: str) -> bytes:
    """The JSON files beside a module: tables that it computes with."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return b""
    return b"".join(path.read_bytes() for path in sorted(Path(spec.origin).parent.glob("*.json")))


@functools.cache
def _source_of(module: str) -> bytes:
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        return b""
    return Path(spec.origin).read_bytes().replace(b"\r\n", b"\n")
