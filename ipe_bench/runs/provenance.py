"""What a result was made of: components as plain data, the versions of their packages, and a digest of their source."""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

TARGET = "_target_"


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


def canonical_json(value: Any) -> str:
    """One text for one value: sorted keys, no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=True)


def fingerprint(components: Iterable[Any]) -> dict[str, Any]:
    """The versions of the packages, and a digest of the numerical source, that components are made of.

    The source of a component is the module of its class with all modules of its package that it imports, so a change in
    anything that it computes with changes the digest, and a new file elsewhere does not. The scoring of trials counts
    as part of it.
    """
    modules = set(_import_closure("ipe_bench.trials.scoring"))
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
