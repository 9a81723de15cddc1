"""Another application of Hydra composes our configs, and makes of them what we do."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import ipe_bench

ROOT = Path(ipe_bench.__file__).parents[1]

APP = """
import hydra
from hydra.utils import instantiate


@hydra.main(version_base="1.3", config_path="my_conf", config_name="config")
def main(config):
    model, noise = instantiate(config.measurement, _convert_="all"), instantiate(config.noise, _convert_="all")
    print(type(model).__name__, model.m, model.rounds, noise.deviation, config.own, sorted(config.estimators))
    print(instantiate(config.estimators.newton, _convert_="all").max_iterations)


main()
"""
CONFIG = """
defaults:
  - measurement: ranging
  - noise: gaussian
  - solver: [newton, fixed_point]
  - own: mine
  - _self_
noise: {deviation: 0.25}
hydra: {output_subdir: null, run: {dir: .}}
"""


@pytest.fixture
def application(tmp_path) -> Path:
    (tmp_path / "my_conf" / "own").mkdir(parents=True)
    (tmp_path / "app.py").write_text(APP)
    (tmp_path / "my_conf" / "config.yaml").write_text(CONFIG)
    (tmp_path / "my_conf" / "own" / "mine.yaml").write_text("a: 1\n")
    return tmp_path


def run(application: Path, *words: str, path: list[Path]) -> subprocess.CompletedProcess[str]:
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, "app.py", *words]
    return subprocess.run(command, cwd=application, capture_output=True, text=True, env=variables, check=False)


@pytest.fixture
def installed(tmp_path) -> Path:
    """What an installation adds beside the package, made as the build is told to."""
    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    places = build["targets"]["wheel"]["force-include"]
    ((source, place),) = [(a, b) for a, b in places.items() if b.startswith("hydra_plugins/")]
    target = tmp_path / "site" / place
    target.parent.mkdir(parents=True)
    target.write_bytes((ROOT / source).read_bytes())
    return tmp_path / "site"


def test_it_composes_our_configs_beside_its_own_which_come_first(application, installed):
    """Plugins in a folder are for our commands alone."""
    done = run(application, "measurement.rounds=7", "estimators.newton.max_iterations=9", path=[ROOT, installed])
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["Ranging 49 7 0.25 {'a': 1} ['fixed_point', 'newton']", "9"]
    assert done.stderr == ""
    for package, text in (
        ("my_conf/noise/gaussian.yaml", "_target_: builtins.dict\ndeviation: 9\n"),
        ("plugins/mine/some_package/__init__.py", ""),
        ("plugins/mine/some_package/conf/noise/odd.yaml", "_target_: some_package.Odd\n"),
    ):
        path = application / package
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    done = run(application, "--cfg", "job", "-p", "noise", path=[ROOT, installed])
    assert "_target_: builtins.dict" in done.stdout
    done = run(application, "noise=odd", "--cfg", "job", path=[ROOT, installed])
    assert done.returncode == 1
    assert "noise/odd" in done.stderr
