"""What a result was made of: components as plain data, the versions of their packages, and a digest of their source."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import sys
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import BLANK_SEAL, cache_folder, is_sealed, seal, write_bytes
from ipe_bench.basics.options import component_classes

TARGET = "_target_"
WITHOUT_NUMBERS = tuple(
    f"ipe_bench.{name}"
    for name in (
        *("basics.errors", "basics.files", "basics.machine", "basics.naming", "basics.statuses"),
        *("runs", "statistics", "real", "plugins", "report", "api", "cli"),
    )
)
"""Modules and rooms that no number of a trial comes from: they word messages, name, store, summarise and show."""
_MOST_SOURCES = 2000
"""Kept in the cache; beyond it, only those that this process read."""
_SESSION = uuid.uuid4().hex
"""Stands for source that no file holds, as of a notebook: what it computed is nobody's but this session's."""


def describe(value: Any) -> Any:
    """A component as plain JSON data: its class and all its fields. Equal numbers are one number: 10.0 is 10."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        cls = type(value)
        fields = {f.name: describe(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {TARGET: f"{cls.__module__}.{cls.__qualname__}", **fields}
    if isinstance(value, np.ndarray):
        return describe(value.tolist())
    if isinstance(value, np.generic):
        return describe(value.item())
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    if isinstance(value, list | tuple):
        return [describe(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): describe(v) for k, v in value.items()}
    return value


def canonical_json(value: Any) -> str:
    """One text for one value: sorted keys, no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=True)


def digest(value: Any) -> str:
    """Sixteen hexadecimal digits that stand for plain data."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:16]


def fingerprint(components: Iterable[Any]) -> dict[str, Any]:
    """The versions of the packages, and a digest of the numerical source, that components are made of.

    The source of a component is the module of its class with all modules of its package that it imports, so a change in
    anything that it computes with changes the digest, and a new file elsewhere does not. The scoring of trials counts
    as part of it. Comments, docstrings, the texts of exceptions and the modules of `WITHOUT_NUMBERS` do not: a change
    of prose leaves every stored result valid.
    """
    modules = set(_import_closure("ipe_bench.trials.scoring"))
    for component in components:
        for cls in component_classes(component):
            modules |= _import_closure(cls.__module__)
    packages = sorted({m.split(".")[0] for m in modules})
    digest = hashlib.sha256("".join(f"{m} {_digest_of(m)}\n" for m in sorted(modules)).encode())
    _known().keep()
    return {"versions": {p: package_version(p) for p in packages}, "source": digest.hexdigest()[:16]}


def class_modules(component: Any) -> set[str]:
    """The modules of the classes of a component and of the components inside it."""
    return {cls.__module__ for cls in component_classes(component)}


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
        if name not in found and not f"{name}.".startswith(tuple(f"{n}." for n in WITHOUT_NUMBERS)):
            found.add(name)
            waiting.extend(_imports(name))
    return frozenset(found)


@functools.cache
def _imports(module: str) -> tuple[str, ...]:
    path = _path_of(module)
    if path is None or path.suffix != ".py":
        return ()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names = {importlib.util.resolve_name(name, package) for name in _source_of(path)["imports"]}
    own = {module.split(".")[0], "ipe_bench"}
    return tuple(sorted(n for n in names if n.split(".")[0] in own and _is_module(n)))


@functools.cache
def _is_module(name: str) -> bool:
    parent = name.rpartition(".")[0]
    try:
        # To look for something in a module would import the module; and only a package has modules in it.
        if parent and not _is_package(parent):
            return False
        return importlib.util.find_spec(name) is not None
    except (ValueError, ImportError):
        return False


@functools.cache
def _is_package(name: str) -> bool:
    spec = importlib.util.find_spec(name)
    return spec is not None and spec.submodule_search_locations is not None


@functools.cache
def _path_of(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
        origin = None if spec is None else spec.origin
    except (ValueError, ImportError):  # a script, a notebook, or a module that was made by hand
        origin = getattr(sys.modules.get(module), "__file__", None)
    return Path(origin) if origin is not None and Path(origin).is_file() else None


@functools.cache
def _source_of(path: Path) -> dict[str, Any]:
    """What a source file imports, as it is written there, and the digest of its numerical code with the JSON files
    beside it, tables of constants."""
    content = path.read_bytes()
    tables = b"".join(table.read_bytes() for table in sorted(path.parent.glob("*.json")))
    return _known().get(content, tables)


class _Sources:
    """What was found in sources before, by the digest of all their bytes: to parse them takes longer than all else in
    a run that has nothing to compute."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.found: dict[str, dict[str, Any]] = {}
        self.used: set[str] = set()
        with contextlib.suppress(OSError, ValueError, KeyError):
            content = path.read_bytes()
            if is_sealed(content):
                self.found = json.loads(content)["found"]
        self.stored = set(self.found)

    def get(self, content: bytes, tables: bytes) -> dict[str, Any]:
        key = hashlib.sha256(hashlib.sha256(content).digest() + tables).hexdigest()
        if key not in self.found:
            tree = ast.parse(content)
            imports, code = _imported(tree), numerical_code(tree).encode()
            self.found[key] = {"imports": imports, "digest": hashlib.sha256(code + tables).hexdigest()}
        self.used.add(key)
        return self.found[key]

    def keep(self) -> None:
        """Leaves what was found to later processes, where there is a place for it."""
        if self.stored.issuperset(self.used):
            return
        if len(self.found) > _MOST_SOURCES:
            self.found = {key: self.found[key] for key in self.used}
        self.stored = set(self.found)
        text = json.dumps({"found": self.found, "seal": BLANK_SEAL})
        with contextlib.suppress(StorageError):
            write_bytes(self.path, seal(text.encode()))


@functools.cache
def _known() -> _Sources:
    reader = hashlib.sha256(Path(__file__).read_bytes() + sys.version.encode()).hexdigest()[:16]
    return _Sources(cache_folder() / f"sources-{reader}.json")


def _imported(tree: ast.Module) -> list[str]:
    """The names of modules, and of what may be modules, that are imported; with leading dots where relative."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            dot = "." if node.module else ""
            names |= {base} | {f"{base}{dot}{alias.name}" for alias in node.names}
    return sorted(names)


@functools.cache
def _digest_of(module: str) -> str:
    """What a module computes with: its code, and the JSON files beside it, tables of constants."""
    path = _path_of(module)
    if path is None:
        return "" if hasattr(sys.modules.get(module), "__path__") else _SESSION
    if path.suffix == ".py":
        return _source_of(path)["digest"]
    tables = b"".join(table.read_bytes() for table in sorted(path.parent.glob("*.json")))
    return hashlib.sha256(path.read_bytes() + tables).hexdigest()


def numerical_code(tree: ast.Module) -> str:
    """Source as one text in which nothing stands that no number depends on: comments, layout, docstrings (also those
    of fields), and the words of exceptions that are raised. The tree is used up."""
    return ast.unparse(_Wordless().visit(tree))


class _Wordless(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        for inner in ast.walk(node):
            if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
                inner.value = "words"
        return node
