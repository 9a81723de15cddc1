"""Describes what a result was made of: components as plain data, versions of packages, and a digest
of their source."""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.definitions import definition_of, importable_digest, is_installed
from ipe_bench.basics.files import kept
from ipe_bench.basics.options import component_classes

TARGET = "_target_"
_ROOMS = ("runs", "statistics", "real", "plugins", "report", "questions", "workshop", "api", "cli")
_BASICS = ("definitions", "errors", "files", "machine", "statuses")
WITHOUT_NUMBERS = (
    *(f"ipe_bench.basics.{name}" for name in _BASICS),
    *(f"ipe_bench.{name}" for name in _ROOMS),
)
"""Modules and rooms that no number of a trial comes from: they word messages, name, store,
summarise and show."""


def describe(value: Any) -> Any:
    """Describes a component as plain JSON data: its class and all fields that count in a
    comparison; 10.0 is 10."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        cls = type(value)
        fields = {
            f.name: describe(getattr(value, f.name)) for f in dataclasses.fields(value) if f.compare
        }
        return {TARGET: f"{cls.__module__}.{cls.__qualname__}", **fields}
    if isinstance(value, np.ndarray):
        return describe(value.tolist())
    if isinstance(value, np.generic):
        return describe(value.item())
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    if isinstance(value, list | tuple):
        # A column of a million numbers takes 0.3 s so, and 3 s entry by entry.
        if all(type(v) is float for v in value):
            return [int(v) if v.is_integer() and abs(v) < 2**53 else v for v in value]
        return [describe(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): describe(v) for k, v in value.items()}
    return value


def identified(value: Any) -> Any:
    """A description whose classes of this package are named by room and class, as every version
    finds them, in any file of the room."""
    if isinstance(value, Mapping):
        return {k: _found_by(v) if k == TARGET else identified(v) for k, v in value.items()}
    return [identified(v) for v in value] if isinstance(value, list) else value


def _found_by(target: str) -> str:
    package, *modules, name = target.split(".")
    return ".".join((package, *modules[:1], name)) if package == "ipe_bench" else target


def canonical_json(value: Any) -> str:
    """Writes one text for one value: sorted keys, no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=True)


def digest(value: Any) -> str:
    """Computes sixteen hexadecimal digits that identify plain data."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:16]


def fingerprint(components: Sequence[Any]) -> dict[str, Any]:
    """Returns the versions of the packages, and a digest of the numerical source, that components
    are made of.

    The source of a component is the module of its class, the modules that its code reaches, all
    that these import from their package or from files that are not installed, and the scoring of
    trials, without comments, docstrings, the texts of exceptions and the modules of
    `WITHOUT_NUMBERS`; and what is not of an installed package as it is in this
    process, which may differ from its file.
    """
    modules = _modules_of(_homes(components))
    digests = [definition_of(component).digest for component in components]
    defined = [digest for digest in digests if digest]
    return {"versions": _versions_of(modules), "source": _source_digest(modules, defined)}


def importable(components: Sequence[Any]) -> dict[str, Any]:
    """Returns the part of the fingerprint that another process has to agree with, since it imports
    it by name."""
    modules = _modules_of(_homes(components) - {"__main__"})
    defined = [importable_digest(component) for component in components]
    return {"versions": _versions_of(modules), "source": _source_digest(modules, defined)}


def _homes(components: Sequence[Any]) -> set[str]:
    homes = {cls.__module__ for component in components for cls in component_classes(component)}
    return homes.union(*(definition_of(component).modules for component in components))


def _modules_of(homes: Iterable[str]) -> set[str]:
    return set[str]().union(*map(_import_closure, ["ipe_bench.trials.scoring", *homes]))


def _versions_of(modules: Iterable[str]) -> dict[str, str]:
    packages = {module.split(".")[0] for module in modules}
    return {package: _package_version(package) for package in sorted(packages)}


def _source_digest(modules: Iterable[str], defined: Iterable[str]) -> str:
    lines = [f"{module} {_source_of(module)[0]}\n" for module in sorted(modules)]
    lines += defined
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:16]


@functools.cache
def _package_version(package: str) -> str:
    """Returns the version of the distribution that a top-level package comes from, where it is
    installed as one."""
    if package == "ipe_bench":
        from ipe_bench import __version__

        return __version__
    for distribution in _distributions().get(package, []):
        return importlib.metadata.version(distribution)
    return "none"


_distributions = functools.cache(importlib.metadata.packages_distributions)
"""Returns the names of the distributions that hold each top-level package."""


def _import_closure(module: str) -> frozenset[str]:
    """Collects the module and, recursively, what it imports from its own top-level package, from
    ipe_bench, or from files that are not installed."""
    return _installed_closure(module) if is_installed(module) else _closure(module)


def _closure(module: str) -> frozenset[str]:
    found: set[str] = set()
    waiting = [module]
    without_numbers = tuple(f"{name}." for name in WITHOUT_NUMBERS)
    while waiting:
        name = waiting.pop()
        if name in found or f"{name}.".startswith(without_numbers):
            continue
        if is_installed(name) and not is_installed(module):
            found |= _installed_closure(name)
            continue
        found.add(name)
        own = {name.split(".")[0], "ipe_bench"}
        for imported in _source_of(name)[1]:
            is_own = imported.split(".")[0] in own
            # An installed package imports nothing that is not.
            is_near = is_own or not (is_installed(module) or is_installed(imported))
            if is_near and _spec_of(imported) is not None:
                waiting.append(imported)
    return frozenset(found)


_installed_closure = functools.cache(_closure)


@functools.cache
def _spec_of(module: str) -> ModuleSpec | None:
    """Finds the source of a module; None if there is no such module, or none that can be found
    again."""
    parent = module.rpartition(".")[0]
    try:
        # To look for something in a module would import the module; and only a package has modules
        # in it.
        if parent:
            package = _spec_of(parent)
            if package is None or package.submodule_search_locations is None:
                return None
        return importlib.util.find_spec(module)
    except (ValueError, ImportError):
        return None


def _source_of(module: str) -> tuple[str, frozenset[str]]:
    """Computes a digest of what a module computes with, its code and the JSON files beside it,
    tables of constants; and the names of modules, and of what may be modules, that it imports."""
    path = None if is_installed(module) else _file_of(module)
    files = () if path is None else (path, *_tables_beside(path))
    written = [(about.st_mtime_ns, about.st_size) for about in map(Path.stat, files)]
    return _source_when(module, tuple(written))


@functools.lru_cache(maxsize=4096)
def _source_when(module: str, written: tuple[tuple[int, int], ...]) -> tuple[str, frozenset[str]]:
    """Computes the same for files that were `written` then, with these sizes."""
    path = _file_of(module)
    if path is None:
        return "", frozenset()
    if module.partition(".")[0] != "ipe_bench":
        return _source_in(path, module)
    # Parsing our own sources takes as long as some fits. Who replaces a file changes its ctime.
    about = [file.stat() for file in (path, *_tables_beside(path))]
    times = [(one.st_mtime_ns, one.st_ctime_ns, one.st_size) for one in about]
    made_of = repr((sys.version, str(path), module, times))
    found = kept(made_of, ".json", lambda: json.dumps(_listed(*_source_in(path, module))).encode())
    digest, names = json.loads(found)
    return digest, frozenset(names)


def _listed(digest: str, imported: frozenset[str]) -> tuple[str, list[str]]:
    return digest, sorted(imported)


def _source_in(path: Path, module: str) -> tuple[str, frozenset[str]]:
    imported = frozenset[str]()
    content = path.read_bytes()
    if path.suffix == ".py":
        tree = ast.parse(content)
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        imported = _imported(tree, package)
        content = numerical_code(tree).encode()
    tables = b"".join(table.read_bytes() for table in _tables_beside(path))
    return hashlib.sha256(content + tables).hexdigest(), imported


def _file_of(module: str) -> Path | None:
    """Returns the file of a module or script; None if no file holds it, such as the cells of a
    notebook."""
    spec = _spec_of(module)
    found = None if spec is None else spec.origin
    origin = getattr(sys.modules.get(module), "__file__", found)  # a script has no spec
    path = None if origin is None else Path(origin)
    return path if path is not None and path.is_file() else None


def _tables_beside(path: Path) -> list[Path]:
    return sorted(path.parent.glob("*.json"))


def _imported(tree: ast.Module, package: str) -> frozenset[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            names.add(base)
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return frozenset(names)


def numerical_code(tree: ast.Module) -> str:
    """Writes source as one text without what no number depends on: comments, layout, docstrings
    (also those of fields), and the words of exceptions that are raised. The tree is used up."""
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
