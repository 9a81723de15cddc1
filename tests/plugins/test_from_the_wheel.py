"""Outside of the checkout, from the wheel: every kind of plugin is made, checked, run and seen in
the report."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import ipe_bench
from ipe_bench.workshop.kinds import KINDS

ROOT = Path(ipe_bench.__file__).parents[1]
pytestmark = pytest.mark.slow


def python(*words: str, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *words]
    return subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, env=os.environ | variables, check=False
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    done = python(
        "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", ".", str(ROOT), cwd=folder
    )
    if done.returncode:
        pytest.skip(f"no wheel can be built here: {done.stderr.splitlines()[-1]}")
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The wheel's content, as an installation leaves it."""
    site = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(site)
    return site


def test_all_kinds_of_plugins_are_made_checked_run_and_seen(installed, tmp_path):
    def run(*words: str) -> str:
        done = python(
            "-m", "ipe_bench", *words, cwd=tmp_path, PYTHONPATH=str(installed), COLUMNS="200"
        )
        assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
        assert done.stderr == "" or words[0] == "run"
        return done.stdout

    where = python(
        "-c", "import ipe_bench; print(ipe_bench.__file__)", cwd=tmp_path, PYTHONPATH=str(installed)
    )
    assert Path(where.stdout.strip()).is_relative_to(installed)
    for kind in KINDS:
        run("new", kind, f"own_{kind}")
    for kind in KINDS:
        assert "all checks passed" in run("check", f"plugins/own_{kind}")
        assert f"own_{kind}" in run("list", "baseline" if kind == "filter" else kind)
    # Parts of reports of their own are in the page of any run.
    chosen = ("measurement=own_measurement", "noise=own_noise", "solver=[own_solver]")
    run("run", *chosen, "trials=20", "output=out", "figures=all")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8").replace("<wbr>", "")
    for text in ("own_statistic", "figure-own_figure", "table-own_table", "What own_section says"):
        assert text in page
