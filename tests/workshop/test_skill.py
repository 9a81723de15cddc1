"""The pages for coding agents: a fresh reader types what they say, and everything works."""

import re
import shlex
from pathlib import Path

import pytest

from ipe_bench.cli.main import main
from ipe_bench.workshop.skill import PAGES

pytestmark = pytest.mark.slow  # to write the pages is to make and to check a component of each kind


@pytest.fixture(scope="module")
def skill(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("home") / "skill"
    assert main(["new", "skill", str(folder)]) == 0
    return folder


def commands(page: Path) -> list[list[str]]:
    return [
        shlex.split(line)
        for line in re.findall(r"^    ipe-bench (.*)$", page.read_text("utf-8"), re.MULTILINE)
    ]


def test_the_router_names_every_page_and_the_pages_are_short(skill):
    router = (skill / "SKILL.md").read_text(encoding="utf-8")
    assert router.startswith("---\nname: ipe-bench\n")
    assert set(re.findall(r"`(new-\w+\.md)`", router)) | {"SKILL.md"} == {
        path.name for path in skill.iterdir()
    }
    assert "\n    ipe-bench run -m error_scale=1,5 " in router
    assert max(path.stat().st_size for path in skill.iterdir()) < 6_500
    assert "Required: `step`." in (skill / "new-solver.md").read_text(encoding="utf-8")
    assert "my_solver" not in router.partition("## Options")[2]


@pytest.mark.parametrize("page", ["SKILL", *(f"new-{kind}" for kind in PAGES)])
def test_what_a_page_says_to_type_works(skill, page, ipe_bench):
    found = commands(skill / f"{page}.md")
    assert len(found) >= 3
    for words in found:
        code, out, error = ipe_bench(*words)
        assert code == 0, f"{words}: {out}{error}"
    (kind,) = [words[1] for words in found if words[0] == "new"] or ["newton"]
    # The component that was made is scored, and a statistic is a column of the summary.
    for summary in Path().rglob("summary.csv"):
        text = summary.read_text(encoding="utf-8")
        nameless = ("newton", "function", "ode", "prior", "execution", "figure", "table", "section")
        assert f"my_{kind}" in text or kind in nameless


def test_a_folder_that_is_there_is_not_overwritten(skill, ipe_bench):
    code, _, error = ipe_bench("new", "skill", str(skill))
    assert code == 2
    assert "is not overwritten" in error
