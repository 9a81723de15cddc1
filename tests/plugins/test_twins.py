"""A plugin that is installed and lies in the folder as well."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ipe_bench.basics.errors import UserError
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


def written(home: Path, **files: str) -> list[discovery.Option]:
    """Writes options of noise of a plugin in a folder, and finds them."""
    package = home / "mine"
    (package / "conf" / "noise").mkdir(parents=True)
    (package / "__init__.py").touch()
    for name, text in files.items():
        (package / "conf" / "noise" / f"{name}.yaml").write_text(text)
    return discovery.options_in(home)


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"a": "defaults: [b]\n", "b": "defaults: [a]\n"}, "names itself, or a file that names it"),
        ({"a": "defaults: [a]\n"}, "names itself, or a file that names it"),
        ({"a": "defaults: [b]\n", "b": "x: [1\n"}, "b.yaml, line 2: is not YAML that can be read"),
        ({"a": "defaults: [b]\n", "b": "7\n"}, "b.yaml: has no keys"),
        ({"a": "defaults: 7\n"}, "a.yaml: defaults: is no list"),
    ],
)
def test_defaults_that_cannot_be_composed_are_refused_in_a_line(
    files: dict[str, str], said: str, tmp_path: Path
) -> None:
    with discovery.added_for_now():
        first = written(tmp_path / "one", **files)[0]
        with pytest.raises(UserError) as error:
            discovery.composed(first)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_empty_defaults_are_none(tmp_path: Path) -> None:
    with discovery.added_for_now():
        (option,) = written(tmp_path / "one", a="defaults:\nx: 1\n")
        assert discovery.composed(option) == {"x": 1}


def test_what_of_a_plugin_in_a_folder_is_passed_over_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    noises = [tmp_path / "plugins" / name / "its" / "conf" / "noise" for name in ("one", "two")]
    for noise in noises:
        noise.mkdir(parents=True)
        (noise / "a.yml").write_text("x: 1\n")
    (noises[1].parents[1] / "__init__.py").touch()
    discovery.sources.cache_clear()
    said = discovery.take_problems()
    discovery.sources.cache_clear()
    assert [line.partition("plugins/")[2] for line in said] == [
        "one/its: has no __init__.py; it is left out, add one",
        "two/its/conf/noise/a.yml: is not read; name it a.yaml",
    ]
