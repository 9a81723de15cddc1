"""Plugins import what plugins/README.md promises to them, and nothing else of the package."""

import ast
import importlib
import re
from pathlib import Path

import pytest

import ipe_bench

PLUGINS = Path(__file__).parents[1]
TEMPLATES = Path(ipe_bench.__file__).parent / "plugins/templates"
TABLE = (
    (PLUGINS / "README.md").read_text(encoding="utf-8").partition("## What a plugin may import")[2]
)
ROWS = [
    line.strip("| ").split(" | ")
    for line in TABLE.partition("\n## ")[0].splitlines()
    if line.startswith("| `")
]
PROMISED = {
    module: re.findall(r"`(\w+)`", names) or importlib.import_module(module).__all__
    for modules, names in ROWS
    for module in re.findall(r"`([\w.]+)`", modules)
}
ROOMS_OF_ZOO = {
    "basics",
    "measurements",
    "estimators",
    "solvers",
    "baselines",
    "statistics",
    "report",
}
"""What the zoo enters of the package."""


def written(folder: Path, suffix: str = ".py") -> list[Path]:
    found = folder.rglob(f"*{suffix}")
    return sorted(path for path in found if "tests" not in path.relative_to(folder).parts)


def imported(path: Path) -> set[tuple[str, str]]:
    """The modules of ipe_bench and the names that a file imports from them."""
    text = re.sub(
        r"\$\{?(\w+)\}?", r"\1", path.read_text(encoding="utf-8")
    )  # of a template, filled in
    found: set[tuple[str, str]] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {(node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names}
    return {(module, name) for module, name in found if module.split(".")[0] == "ipe_bench"}


STUDIES = {"zoo", "lost_tracks"}
"""Folders that enter rooms: the zoo, which is tested with the package, and scripts that are no
plugins."""
OTHERS = [path for path in written(PLUGINS) if STUDIES.isdisjoint(path.relative_to(PLUGINS).parts)]
MADE = [path for path in written(TEMPLATES, ".py.template") if "test" not in path.name]


@pytest.mark.parametrize("path", [*OTHERS, *MADE], ids=lambda path: path.name)
def test_a_plugin_imports_what_is_promised(path):
    assert [one for one in imported(path) if one[1] not in ["", *PROMISED.get(one[0], ())]] == []
    assert {module for module, name in imported(path) if not name} <= {"ipe_bench"}


@pytest.mark.parametrize("module", PROMISED)
def test_what_is_promised_is_there(module):
    for name in PROMISED[module]:
        exec(f"from {module} import {name}")


def test_the_zoo_enters_no_other_rooms():
    modules = {module for path in written(PLUGINS / "zoo") for module, _ in imported(path)}
    assert {module.split(".")[1] for module in modules if "." in module} == ROOMS_OF_ZOO
