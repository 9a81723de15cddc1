"""The documentation: what its pages tell readers to type works, links lead somewhere, and nothing is fetched."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import ipe_bench
from ipe_bench.baselines import EKF
from ipe_bench.cli.main import COMMANDS
from ipe_bench.measurements import Polynomial
from ipe_bench.noise import Gaussian
from ipe_bench.plugins import discovery
from ipe_bench.plugins.construct import described
from ipe_bench.report.docs import __main__ as pages
from ipe_bench.report.docs import show_type, type_of

PAGES = Path(str(files("ipe_bench.report.docs"))) / "pages"
WRITTEN = sorted(PAGES.rglob("*.md"))


def ids(path: Path) -> str:
    return str(path.relative_to(PAGES))


def nothing_new(option, folder, *_):
    """Stands for an experiment of which nothing is stored."""
    empty = {"command": "", "version": "", "trials": "", "html": "", "figures": [], "best": []}
    (folder / f"{option.name}.json").write_text(json.dumps(empty))


@pytest.fixture(scope="module")
def generated(tmp_path_factory) -> Path:
    """The pages that nobody writes; of the gallery its list alone, as no experiment is run."""
    folder = tmp_path_factory.mktemp("generated")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pages, "store", nothing_new)
        pages.write_reference(folder / "reference")
        pages.write_gallery(folder / "gallery", folder, 1)
    return folder


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


FILTERS = blocks(PAGES / "howto" / "write_filter.md", "python")


STORED = sorted((PAGES.parent / "gallery").glob("*.json"))


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_what_is_stored_of_an_experiment_says_what_computed_it_and_shows_it_first(path):
    found = json.loads(path.read_text(encoding="utf-8"))
    assert path.stem in [option.name for option in discovery.options("experiment")]
    assert found["command"].startswith(f"run +experiment={path.stem}")
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*", found["version"])
    assert found["html"].index("<p>") < found["html"].index("<table")  # the answer, then the numbers
    counts = {int(count.replace(",", "")) for count in found["trials"].split(" to ")}
    assert min(counts) >= 100 or counts == {1}
    pictures = [f"{path.stem}.png", *(f"{path.stem}_{one['name']}.png" for one in found["figures"])]
    sizes = [(path.parent / name).stat().st_size for name in pictures]
    assert max(sizes) < 100_000
    assert path.stat().st_size < 100_000
    assert not re.search(r"(/home|/root|/tmp|outputs)/", path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", WRITTEN, ids=ids)
def test_links_lead_to_pages(page, generated):
    for link in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        target = (page.parent / link).resolve()
        made = generated / target.relative_to(PAGES.resolve())
        assert target.exists() or made.exists() or link.startswith("gallery/pictures/"), link


def test_options_are_described_from_class_and_config_and_say_what_they_mean():
    rows = {row.name: row for option in discovery.options("solver") for row in described(option)}
    assert rows["growth"].value == "2"
    assert rows["tolerance"].kind == "a number above 0"
    assert rows["budget"].value == "null"
    assert rows["depth"].meaning == "past steps that each new one draws on"
    every = [option for group in ("solver", "baseline", "noise", "measurement") for option in discovery.options(group)]
    ours = [option for option in every if option.source.name == "ipe-bench"]
    assert [f"{option.name}.{row.name}" for option in ours for row in described(option) if not row.meaning] == []


def test_every_command_has_a_section(generated):
    page = (generated / "reference" / "commands.md").read_text(encoding="utf-8")
    found = set(re.findall(r"^## (\w+)$", page, re.MULTILINE))
    assert found == set(COMMANDS)


@pytest.mark.slow
def test_the_cells_of_the_notebook_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for code in blocks(PAGES / "howto" / "notebook.md", "{code-cell} python"):
        exec(code, names)
    assert next(iter(names["table"].figures)) == "headline"
    assert (tmp_path / "outputs" / "notebook" / "report.html").exists()


@pytest.mark.parametrize("code", FILTERS, ids=range(len(FILTERS)))
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_filters_of_the_page_are_the_kalman_filter_on_a_linear_model(code, noise):
    names: dict = {"__name__": __name__}
    exec(compile(code, "write_filter.md", "exec", dont_inherit=True), names)
    scenario = ipe_bench.Scenario(Polynomial(strength=0.0), Gaussian(0.01))
    z = scenario.draw(0, 5).z
    mine = names.get("MyFilter") or names["Julier"]
    ours, kalman = (one(process_noise=noise).estimate(scenario.problem, z) for one in (mine, EKF))
    assert ours.covariance is not None
    assert kalman.covariance is not None
    np.testing.assert_allclose(ours.x, kalman.x, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(ours.covariance, kalman.covariance, rtol=1e-6, atol=1e-12)
    with pytest.raises(ipe_bench.UserError, match="engine=filterpy: this filter has no track"):
        type("Neither", (ipe_bench.Sequential,), {})()


def test_attributes_of_public_classes_have_types_that_are_types():
    lines = ["no limit.", "", ":type: Simulations that a trial may cost; None"]  # as napoleon leaves them
    show_type(None, "attribute", "ipe_bench.IPE.budget", None, None, lines)
    assert lines == ["Simulations that a trial may cost; None: no limit.", "", "", ":type: float | None"]
    classes = [thing for name in ipe_bench.__all__ if isinstance(thing := getattr(ipe_bench, name), type)]
    assert {ipe_bench.IPE, ipe_bench.State, ipe_bench.Sequential, ipe_bench.OdeMeasurement} <= set(classes)
    names = [(cls, name) for cls in classes for name in vars(cls).get("__annotations__", {})]
    assert len(names) > 50
    assert [one for one in names if not re.fullmatch(r"[\w.]+(\[.*\])?( \| .*)?", type_of(*one))] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in WRITTEN if blocks(p, "console") or blocks(p, "python")], ids=ids)
def test_what_a_page_says_to_type_works(page, tmp_path):
    environment = os.environ | {"NO_COLOR": "1"}
    for name, content in re.findall(r"Write a file `(\S+)`:\n\n```text\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
        (tmp_path / name).write_text(content, encoding="utf-8")
    for line in "".join(blocks(page, "console")).splitlines():
        program = [sys.executable, "-m", "ipe_bench", *shlex.split(line.removeprefix("$ ipe-bench "))]
        done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    for code in blocks(page, "python"):
        program = [sys.executable, "-c", code]
        done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_whole_site_builds_without_a_warning_and_fetches_nothing(tmp_path):
    """Every experiment, and a line about each that runs without a stored result."""
    pytest.importorskip("pydata_sphinx_theme")
    # In a process of its own, as a user builds it: what its libraries will do away with is no error of ours.
    command = [sys.executable, "-m", "ipe_bench.report.docs", str(tmp_path), "--trials=1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    html = tmp_path / "html"
    ours = [option.name for option in discovery.options("experiment") if option.source.name == "ipe-bench"]
    assert {"nist", "polynomial"} <= set(ours)
    assert 'href="gallery/ranging.html"' in (html / "choosing.html").read_text(encoding="utf-8")
    assert "100 trials per row" in (html / "howto" / "notebook.html").read_text(encoding="utf-8")
    for name in ours:
        ran = f"{name}: no result of it is stored; it runs now" in done.stdout
        assert ran == (not (PAGES.parent / "gallery" / f"{name}.json").exists())
        page = (html / "gallery" / f"{name}.html").read_text(encoding="utf-8")
        assert f"experiment={name}" in re.sub("<[^>]*>", "", page)  # without the marks of colours
        assert "<table" in page
        assert str(tmp_path) not in page
    fetched = r"""<(?:script|img|iframe|link(?=[^>]*stylesheet))[^>]*(?:src|href)=["']?(?:https?:)?//"""
    assert [page for page in html.rglob("*.html") if re.search(fetched, page.read_text(encoding="utf-8"))] == []
