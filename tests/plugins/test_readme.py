"""What plugins/README.md says of where things are is so."""

import re
from pathlib import Path

import pytest

import ipe_bench

ROOT = Path(__file__).parents[2]
README = (ROOT / "plugins/README.md").read_text(encoding="utf-8")
ANSWERS = [line for line in README.partition("## Where things are")[2].splitlines() if line.startswith("| Where")]


def test_questions_are_answered():
    assert ANSWERS


@pytest.mark.parametrize("answer", ANSWERS)
def test_an_answer_names_what_is_there(answer):
    paths = [ROOT / path for path in re.findall(r"`(ipe_bench/[\w/]+\.py)`", answer)]
    assert paths
    assert all(path.is_file() or (path.stem == "NAME" and path.parent.is_dir()) for path in paths)
    for name, path in re.findall(r"`(?:\w+\.)*(\w+)(?:\([\w, ]*\))?` in `(ipe_bench/[\w/]+\.py)`", answer):
        defined = rf"^ *(def|class) {name}\b|^{name}\b"
        assert re.search(defined, (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE), name


def test_the_bases_that_it_names_are_public():
    table = README.partition("| kind | derive from")[2].partition("\n\n")[0]
    for name in re.findall(r"`ipe_bench\.(\w+)`", table):
        assert hasattr(ipe_bench, name)
