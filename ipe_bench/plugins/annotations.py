"""The options of a component as its source states them, without importing it: for who has no time to load libraries.

A shell that completes a word asks here. What may be given in full, and what is wrong with a value, is left to
`basics.options`, which reads the classes themselves.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path

_DEEPEST = 8
"""Names that stand for names: no module of ours or of a plugin goes so deep."""


@dataclass(frozen=True)
class Stated:
    """One field of a dataclass as it is written."""

    name: str
    annotation: ast.expr
    meaning: str
    """The first sentence of the text below it."""
    module: str
    """Where the names in the annotation are known."""


def stated(target: str) -> dict[str, Stated]:
    """The fields of the class of that dotted name, those of its bases first; none where its source is not found."""
    module, _, name = target.rpartition(".")
    return {field.name: field for field in _fields(module, name, _DEEPEST)}


def choices(field: Stated) -> list[str]:
    """What may be chosen, where its type names all of it: literals, true and false, null."""
    return list(dict.fromkeys(_choices(field.annotation, field.module, _DEEPEST)))


@functools.cache
def _tree(module: str) -> ast.Module | None:
    """The source of a module; its packages are found but not imported."""
    path: list[str] | None = None
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        spec = PathFinder.find_spec(".".join(parts[:count]), path)
        if spec is None:
            return None
        path = list(spec.submodule_search_locations or [])
    try:
        return ast.parse(Path(spec.origin).read_text(encoding="utf-8")) if spec.origin else None  # type: ignore[union-attr]
    except (OSError, SyntaxError, ValueError):
        return None


def _defined(module: str, name: str, depth: int) -> tuple[str, ast.stmt] | None:
    """The statement that gives a name its meaning, and its module: followed to where it is imported from."""
    tree = _tree(module)
    if tree is None or depth == 0:
        return None
    for statement in tree.body:
        match statement:
            case ast.ClassDef(name=defined) if defined == name:
                return module, statement
            case ast.Assign(targets=[ast.Name(defined)]) if defined == name:
                return module, statement
            case ast.ImportFrom(module=str(other), level=0):
                for alias in statement.names:
                    if (alias.asname or alias.name) == name:
                        return _defined(other, alias.name, depth - 1)
    return None


def _fields(module: str, name: str, depth: int) -> Iterator[Stated]:
    found = _defined(module, name, depth)
    if found is None or not isinstance(found[1], ast.ClassDef):
        return
    home, body = found[0], found[1].body
    for base in reversed(found[1].bases):
        generic = base.value if isinstance(base, ast.Subscript) else base
        if isinstance(generic, ast.Name):
            yield from _fields(home, generic.id, depth - 1)
    if not any("dataclass" in ast.dump(decorator) for decorator in found[1].decorator_list):
        return
    for statement, text in zip(body, [*body[1:], None], strict=True):
        match statement:
            case ast.AnnAssign(target=ast.Name(field), annotation=annotation) if "ClassVar" not in ast.dump(annotation):
                yield Stated(field, annotation, _first_sentence(text), home)


def _first_sentence(text: ast.stmt | None) -> str:
    match text:
        case ast.Expr(value=ast.Constant(value=str(words))):
            return " ".join(words.split()).partition(". ")[0].removesuffix(".")
    return ""


def _choices(annotation: ast.expr, module: str, depth: int) -> Iterator[str]:
    match annotation:
        case ast.BinOp(left=left, op=ast.BitOr(), right=right):
            yield from _choices(left, module, depth)
            yield from _choices(right, module, depth)
        case ast.Constant(value=None):
            yield "null"
        case ast.Name("bool"):
            yield from ("true", "false")
        case ast.Subscript(value=ast.Name("Literal"), slice=ast.Tuple(elts=values)):
            yield from (str(value.value) for value in values if isinstance(value, ast.Constant))
        case ast.Subscript(value=ast.Name("Literal"), slice=ast.Constant(value=value)):
            yield str(value)
        case ast.Subscript(value=ast.Name("Annotated"), slice=ast.Tuple(elts=[kind, *_])):
            yield from _choices(kind, module, depth)
        case ast.Name(alias):
            found = _defined(module, alias, depth)
            if found is not None and isinstance(found[1], ast.Assign):
                yield from _choices(found[1].value, found[0], depth - 1)
