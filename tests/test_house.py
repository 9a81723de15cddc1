"""The rooms of the package stand in one line, and nothing is imported against it."""

from __future__ import annotations

import ast
import functools
import re
import tomllib
from pathlib import Path

import yaml

import ipe_bench

HOUSE = Path(ipe_bench.__file__).parent
ROOT = HOUSE.parent
LINE = [
    *(
        ["basics"],
        ["engine"],
        ["functions"],
        ["measurements"],
        ["noise", "priors", "states"],
        ["estimators"],
        ["solvers", "baselines"],
        ["trials"],
    ),
    *(
        ["runs"],
        ["statistics"],
        ["real", "plugins"],
        ["report"],
        ["questions", "workshop"],
        ["api"],
        ["cli"],
    ),
]
PLACE = {room: place for place, rooms in enumerate(LINE) for room in rooms}
HEAVY_BELOW = {
    "matplotlib": "report",
    "seaborn": "report",
    "hydra": "cli",
    "omegaconf": "cli",
    "rich": "report",
}
MODULES = [
    (path, path.relative_to(HOUSE).with_suffix("").parts[0])
    for path in sorted(HOUSE.rglob("*.py"))
    if path.relative_to(HOUSE).with_suffix("").parts[0] in PLACE
]


@functools.cache
def statements(path: Path) -> list[tuple[frozenset[str], bool, bool]]:
    """What each import of a file names, whether it is for type checkers alone, and whether it
    stands in a function."""
    found = []

    def visit(node: ast.AST, for_types: bool, late: bool) -> None:
        for_types |= isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        late |= isinstance(node, ast.FunctionDef)
        if isinstance(node, ast.Import):
            found.append((frozenset(alias.name for alias in node.names), for_types, late))
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            found.append((frozenset(names), for_types, late))
        elif not isinstance(node, ast.expr):  # which holds no statement
            for child in ast.iter_child_nodes(node):
                visit(child, for_types, late)

    visit(ast.parse(path.read_text(encoding="utf-8")), False, False)
    return found


def imported(path: Path, *, checked_types: bool, late: bool = True) -> set[str]:
    """The modules that a file imports: late ones too unless told otherwise, those for type checkers
    where asked for."""
    kept = (
        names
        for names, types, inside in statements(path)
        if types <= checked_types and inside <= late
    )
    return {name for names in kept for name in names}


def test_nothing_is_imported_against_the_line():
    for path, room in MODULES:
        for name in imported(path, checked_types=True):
            parts = name.split(".")
            if parts[0] == "ipe_bench" and len(parts) > 1 and parts[1] in PLACE:
                assert PLACE[parts[1]] <= PLACE[room], (
                    f"{path} imports {name}, which stands later in the line"
                )
                rooms = LINE[PLACE[room]]
                assert parts[1] == room or parts[1] not in rooms, (
                    f"{path} imports {name}, its neighbour in the line"
                )


PICTURE = re.compile(r"^(\w*) {2,}(\w+) {2,}(\S.*)$", re.MULTILINE)


def storeys() -> list[tuple[str, str, str]]:
    """The picture of plugins/README.md from the ground up: storey, room, and what it does."""
    readme = (HOUSE.parent / "plugins/README.md").read_text(encoding="utf-8")
    drawn = readme.partition("## Where things are")[2].split("```")[1].removeprefix("text")
    storey = ""
    found = []
    for named, room, does in PICTURE.findall(drawn):
        storey = named or storey
        found.append((storey, room, does))
    return found[::-1]


def test_the_picture_of_the_house_has_every_room_above_those_that_it_imports():
    place = {room: i for i, (_, room, _) in enumerate(storeys())}
    assert place.keys() == PLACE.keys()
    for path, room in MODULES:
        for name in imported(path, checked_types=True):
            parts = name.split(".")
            if parts[0] == "ipe_bench" and len(parts) > 1 and parts[1] in place:
                assert place[parts[1]] <= place[room], f"{path} imports {name}, drawn above it"


def test_the_picture_has_five_storeys_and_names_each_room_in_five_words():
    assert list(dict.fromkeys(storey for storey, _, _ in storeys())) == [
        *("ground", "models", "methods", "bench", "answers")
    ]
    assert [room for _, room, does in storeys() if len(does.split()) != 5] == []
    folders = {path.name for path in HOUSE.iterdir() if (path / "__init__.py").is_file()}
    assert folders <= {room for _, room, _ in storeys()}


def test_rooms_know_only_the_libraries_that_are_theirs():
    for path, room in MODULES:
        for name in imported(path, checked_types=False):
            home = HEAVY_BELOW.get(name.split(".")[0])
            assert home is None or PLACE[room] >= PLACE[home], (
                f"{path} knows {name}, which belongs to {home} and above"
            )


def test_all_texts_of_consoles_leave_by_one_door():
    """Rich's own console obeys what a name says to a terminal."""
    homes = {
        path.name
        for path, _ in MODULES
        if "rich.console.Console" in imported(path, checked_types=False)
    }
    assert homes == {"screen.py"}


def test_the_package_imports_no_plugin():
    names = {name for path in HOUSE.rglob("*.py") for name in imported(path, checked_types=True)}
    assert [name for name in names if name.startswith("ipe_bench_")] == []


def edges(*, late: bool) -> dict[str, set[str]]:
    """Which modules of the package each module imports."""
    paths = {
        ".".join(("ipe_bench", *p.relative_to(HOUSE).with_suffix("").parts)): p
        for p in HOUSE.rglob("*.py")
    }
    paths = {
        name.removesuffix(".__init__"): path
        for name, path in paths.items()
        if name != "ipe_bench.__init__"
    }
    found = {name: imported(path, checked_types=False, late=late) for name, path in paths.items()}
    # A package imports its own modules, which may name it in turn only through another room.
    return {
        name: {n for n in found[name] if n in paths and n != name and not name.startswith(f"{n}.")}
        for name in paths
    }


def test_modules_import_each_other_in_no_circle():
    imports = edges(late=True)
    done: set[str] = set()

    def walk(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail[trail.index(name) :], name))
        if name not in done:
            for other in sorted(imports[name]):
                walk(other, (*trail, name))
            done.add(name)

    for name in sorted(imports):
        walk(name, ())


def test_rooms_import_each_other_in_no_circle_and_at_most_fourteen_deep():
    imports: dict[str, set[str]] = {}
    for name, others in edges(late=True).items():
        room = name.split(".")[1]
        imports.setdefault(room, set()).update(other.split(".")[1] for other in others)

    def deepest(room: str, trail: tuple[str, ...]) -> tuple[str, ...]:
        assert room not in trail, " -> ".join((*trail, room))
        below = (deepest(other, (*trail, room)) for other in sorted(imports[room] - {room}))
        return (room, *max(below, key=len, default=()))

    chains = [deepest(room, ()) for room in imports]
    assert max(map(len, chains)) <= 14, max(chains, key=len)


def test_every_place_names_one_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    zoo = tomllib.loads((ROOT / "plugins/zoo/pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    notes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert citation["version"] == zoo["version"] == ipe_bench.__version__
    assert f"\n## {ipe_bench.__version__}, {citation['date-released']}\n" in notes
