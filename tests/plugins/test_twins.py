"""A plugin that is installed and lies in the folder as well."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery

CHOSEN = (
    "measurement=polynomial",
    "noise=gaussian",
    "solver=[twin]",
    "baseline=[linear_lse]",
    "block_size=2",
)


def run(*words: str, site: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ipe_bench", *words]
    environment = os.environ | {"PYTHONPATH": str(site), "COLUMNS": "200"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A solver in `plugins/twin`, and the same distribution installed in another folder, where its
    source is broken."""
    monkeypatch.chdir(tmp_path)
    assert main(["new", "solver", "twin"]) == 0
    discovery.sources.cache_clear()
    site = tmp_path / "site"
    shutil.copytree("plugins/twin/ipe_bench_twin", site / "ipe_bench_twin")
    with (site / "ipe_bench_twin/twin.py").open("a") as source:
        source.write("\nraise RuntimeError('this is the installed copy')\n")
    described = site / "ipe_bench_twin-0.1.0.dist-info"
    described.mkdir()
    (described / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: IPE_bench.twin\nVersion: 0.1.0\n"
    )
    (described / "entry_points.txt").write_text("[ipe_bench.plugins]\ntwin = ipe_bench_twin\n")
    return site


@pytest.mark.slow
def test_of_one_distribution_the_folders_copy_runs_in_workers_too_and_nothing_is_said(site):
    listed = run("list", "solver", site=site)
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "\nsolver, from plugins/twin\n" in listed.stdout
    done = run(
        "run",
        *CHOSEN,
        "trials=4",
        "execution=processes",
        "execution.workers=1",
        "output=out",
        "figures=none",
        site=site,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "left out" not in done.stderr


@pytest.mark.slow
def test_what_is_installed_runs_where_the_folder_holds_none(site, tmp_path):
    shutil.rmtree(tmp_path / "plugins")
    done = run("run", *CHOSEN, "trials=4", "output=out", site=site)
    assert done.returncode == 2
    assert "this is the installed copy" in done.stderr


@pytest.mark.slow
def test_another_distribution_of_that_package_is_named_and_left_out(site, tmp_path):
    project = tmp_path / "plugins/twin/pyproject.toml"
    project.write_text(
        project.read_text().replace('name = "ipe-bench-twin"', 'name = "somebody-elses"')
    )
    done = run("run", *CHOSEN, "trials=4", "output=out", site=site)
    installed, left_out = site / "ipe_bench_twin", tmp_path / "plugins/twin/ipe_bench_twin"
    assert (
        f"plugin {left_out}: {installed} is called ipe_bench_twin too; it is left out"
        in done.stderr
    )
    assert done.returncode == 2
    assert "this is the installed copy" in done.stderr


@pytest.mark.slow
def test_a_copy_that_was_imported_already_goes_on(site, monkeypatch):
    (site / "ipe_bench_twin/twin.py").write_bytes(
        Path("plugins/twin/ipe_bench_twin/twin.py").read_bytes()
    )
    code = "import ipe_bench_twin; from ipe_bench.cli.main import main; main(['list', 'solver'])"
    environment = os.environ | {"PYTHONPATH": str(site), "COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    assert "is called ipe_bench_twin too; it is left out" in done.stderr
    assert "\nsolver, from IPE_bench.twin 0.1.0\n" in done.stdout
