"""What plugins/README.md says of where things are is so."""

import importlib
import re
import sys
from pathlib import Path

import pytest

import ipe_bench
from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery

ROOT = Path(__file__).parents[2]
README = (ROOT / "plugins/README.md").read_text(encoding="utf-8")
ANSWERS = [
    line
    for line in README.partition("## Where things are")[2].splitlines()
    if line.startswith("| ") and "`ipe_bench/" in line
]


def test_questions_are_answered():
    assert ANSWERS


@pytest.mark.parametrize("answer", ANSWERS)
def test_an_answer_names_what_is_there(answer):
    paths = [ROOT / path for path in re.findall(r"`(ipe_bench/[\w/]+\.py)`", answer)]
    assert paths
    assert all(path.is_file() or (path.stem == "NAME" and path.parent.is_dir()) for path in paths)
    for name, path in re.findall(
        r"`(?:\w+\.)*(\w+)(?:\([\w, ]*\))?` in `(ipe_bench/[\w/]+\.py)`", answer
    ):
        defined = rf"^ *(def|class) {name}\b|^{name}\b"
        assert re.search(defined, (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE), name


def test_the_classes_that_it_names_have_contracts():
    rows = README.partition("| kind | class")[2].partition("\n\n")[0].splitlines()[2:]
    named = {row.split()[1]: tuple(re.findall(r"`(ipe_bench\.[\w.]+)`", row)) for row in rows}
    assert named == {**discovery.CONTRACTS, "experiment": ()}


BASES = {
    "solver": ipe_bench.IPE,
    "measurement model": ipe_bench.Measurement,
    "noise": ipe_bench.Noise,
}
"""What a new one of the thing that a question asks after derives from."""
MADE = [
    (thing, kind)
    for answer in ANSWERS
    for thing in re.findall(r"^\| a new ([\w ]+) \|", answer)
    for kind in re.findall(r"`ipe-bench new (\w+) NAME`", answer)
]


def test_every_thing_that_a_plugin_may_hold_has_its_command():
    assert [thing for thing, _ in MADE] == list(BASES)


@pytest.mark.parametrize(("thing", "kind"), MADE)
def test_the_command_that_the_map_names_makes_what_the_question_asks_for(
    thing, kind, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    name = f"map_{kind}"
    assert main(["new", kind, name]) == 0
    monkeypatch.syspath_prepend(tmp_path / "plugins" / name)
    module = importlib.import_module(f"ipe_bench_{name}.{name}")
    written = [
        one for one in vars(module).values() if getattr(one, "__module__", "") == module.__name__
    ]
    assert any(isinstance(one, type) and issubclass(one, BASES[thing]) for one in written)
    for each in (module.__name__, f"ipe_bench_{name}"):
        del sys.modules[each]
    discovery.sources.cache_clear()
