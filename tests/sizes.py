"""How large and how dense each room is, as the table that `make lint` prints, and the limits that
`test_sizes.py` holds.

Content is counted in nodes of the syntax tree, without docstrings, annotations, imports and
signatures, so that neither lines nor prose weigh. A dense statement has more than fifteen nodes; in
well-kept libraries of the field three to nine statements in a hundred are dense.
"""

from __future__ import annotations

import ast
import csv
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DENSE = 15
"""Nodes from which on a statement counts as dense."""
LIMITS = Path(__file__).parent / "room_limits.tsv"
"""A row per room: its largest content, and what users got for each time that it was raised."""
_NO_CONTENT = (ast.expr_context, ast.operator, ast.cmpop, ast.boolop, ast.unaryop)
_FRAME = (
    *(ast.Import, ast.ImportFrom, ast.alias, ast.FunctionDef),
    *(ast.AsyncFunctionDef, ast.ClassDef, ast.arguments, ast.arg),
)
_COMPOUND = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Import, ast.ImportFrom)
_DATA = (ast.Tuple, ast.List, ast.Dict, ast.Set)


def without_prose(tree: ast.Module) -> ast.Module:
    """Strips docstrings, annotations and the words of f-strings."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [one for one in node.body if not _is_text(one)] or [ast.Pass()]
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Name("x", ast.Load())
        elif isinstance(node, ast.JoinedStr):
            node.values = [one for one in node.values if isinstance(one, ast.FormattedValue)]
    return tree


def _is_text(statement: ast.stmt) -> bool:
    if not isinstance(statement, ast.Expr) or not isinstance(statement.value, ast.Constant):
        return False
    return isinstance(statement.value.value, str)


def own_nodes(statement: ast.stmt) -> int:
    """Counts the nodes of a statement without those of the statements in it."""
    number = 0
    left: list[ast.AST] = [statement]
    while left:
        node = left.pop()
        number += not isinstance(node, _NO_CONTENT)
        left += [child for child in ast.iter_child_nodes(node) if not isinstance(child, ast.stmt)]
    return number


def gauges(path: Path) -> Counter[str]:
    """Counts content, statements, dense ones, packed assignments `a, b = c, d`, and walruses of a
    file."""
    source = path.read_text(encoding="utf-8")
    tree = without_prose(ast.parse(source))
    nodes = list(ast.walk(tree))
    assigned = [node for node in nodes if isinstance(node, ast.Assign)]
    tables = {
        id(one)
        for one in tree.body
        if isinstance(one, ast.Assign | ast.AnnAssign) and _is_table(one)
    }
    simple = [
        own_nodes(node)
        for node in nodes
        if isinstance(node, ast.stmt) and not isinstance(node, _COMPOUND) and id(node) not in tables
    ]
    packed = [
        one
        for one in assigned
        if isinstance(one.value, ast.Tuple) and isinstance(one.targets[0], ast.Tuple)
    ]
    return Counter(
        files=1,
        lines=len(source.splitlines()),
        content=_content(nodes),
        statements=len(simple),
        dense=sum(number > DENSE for number in simple),
        packed=len(packed),
        walruses=sum(isinstance(node, ast.NamedExpr) for node in nodes),
    )


def content(path: Path) -> int:
    """Counts the content of a file."""
    return _content(ast.walk(without_prose(ast.parse(path.read_text(encoding="utf-8")))))


def _content(nodes: Iterable[ast.AST]) -> int:
    return sum(not isinstance(node, (*_NO_CONTENT, *_FRAME)) for node in nodes)


def _is_table(statement: ast.Assign | ast.AnnAssign) -> bool:
    return isinstance(statement.value, _DATA)


def python_files(folder: Path, *, tests: bool) -> list[Path]:
    files = (path for path in sorted(folder.rglob("*.py")) if ".venv" not in path.parts)
    return [path for path in files if ("tests" in path.relative_to(ROOT).parts) is tests]


def summed(files: Iterable[Path]) -> Counter[str]:
    return sum(map(gauges, files), Counter())


def row(name: str, found: Counter[str]) -> str:
    share = found["dense"] / max(found["statements"], 1)
    return (
        f"{name:<40}{found['files']:>6}{found['lines']:>8,}{found['content']:>9,}{share:>8.1%}"
        f"{found['packed']:>8}{found['walruses']:>10}"
    )


def room_files() -> dict[str, list[Path]]:
    """The package's files by room: a folder of `ipe_bench`, or a module at its top."""
    package = ROOT / "ipe_bench"
    rooms: dict[str, list[Path]] = {}
    for path in python_files(package, tests=False):
        room = path.relative_to(package).with_suffix("").parts[0]
        rooms.setdefault(room, []).append(path)
    return rooms


def limits() -> dict[str, int]:
    """The largest content that each room may have."""
    with LIMITS.open(encoding="utf-8", newline="") as file:
        return {one["room"]: int(one["limit"]) for one in csv.DictReader(file, delimiter="\t")}


def rows() -> Iterator[str]:
    package = ROOT / "ipe_bench"
    yield f"{'':<40}{'files':>6}{'lines':>8}{'content':>9}{'dense':>8}{'packed':>8}{'walruses':>10}"
    found = {room: summed(files) for room, files in room_files().items()}
    allowed = limits()
    for room in sorted(found, key=lambda room: -found[room]["content"]):
        yield f"{row(room, found[room])}, at most {allowed.get(room, 0):,}"
    yield row("ipe_bench", sum(found.values(), Counter()))
    for plugin in sorted({path.parent for path in (ROOT / "plugins").rglob("pyproject.toml")}):
        yield row(str(plugin.relative_to(ROOT)), summed(python_files(plugin, tests=False)))
    tests = [*python_files(ROOT / "tests", tests=True), *python_files(ROOT / "plugins", tests=True)]
    yield row("tests", summed(tests))
    drawn = {".js": 0, ".css": 0, ".j2": 0, ".template": 0}
    for path in package.rglob("*"):
        if path.suffix in drawn:
            drawn[path.suffix] += path.stat().st_size
    yield "bytes: " + ", ".join(f"{suffix[1:]} {size:,}" for suffix, size in drawn.items())


if __name__ == "__main__":
    print("\n".join(rows()))
