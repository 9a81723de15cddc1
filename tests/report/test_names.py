"""One thing has one name, in code, options, pages and pictures."""

import re
from pathlib import Path

import pytest

from ipe_bench.basics.errors import RENAMED, unknown

ROOT = Path(__file__).parents[2]
DEAD = {
    **{rf"\b{name}\b": name for name in RENAMED},
    r"[Nn]ominal[ \n]+point": "start",
    r"platform tilt|tilt [xyz]\b|\btilted (by|platform)|platform tilted": "platform misalignment",
    r"\bpessimistic\b": "too cautious",
    r"54 problems": "27 problems from two starts",
}
"""Patterns of names that a thing had beside the one it has now."""
HISTORY = ("CHANGELOG.md", "ipe_bench/basics/errors.py")
FOLDERS = ("conf", "ipe_bench", "plugins")


def texts():
    """Yields what people read of the project: name and text."""
    places = [ROOT / "README.md", *(p for name in FOLDERS for p in (ROOT / name).rglob("*"))]
    for path in places:
        name = path.relative_to(ROOT).as_posix()
        if path.suffix in (".md", ".py", ".yaml", ".template", ".html") and name not in HISTORY:
            yield name, path.read_text(encoding="utf-8")


def test_a_thing_has_one_name_everywhere():
    dead = re.compile("|".join(DEAD))
    found = [f"{name}: {match[0]}" for name, text in texts() for match in dead.finditer(text)]
    assert not found


@pytest.mark.parametrize("old", RENAMED)
def test_an_option_of_an_earlier_version_is_refused_with_its_name_now(old):
    assert unknown(old, ["ekf"], "option") == f"is {RENAMED[old]} now"
    assert list((ROOT / "conf").glob(f"*/{RENAMED[old]}.yaml"))
