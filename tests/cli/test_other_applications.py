"""Another application of Hydra composes our configs, and makes of them what we do."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import ipe_bench

ROOT = Path(ipe_bench.__file__).parents[1]
APP = """
import hydra
from hydra.utils import instantiate


@hydra.main(version_base="1.3", config_path="my_conf", config_name="config")
def main(config):
    model = instantiate(config.measurement, _convert_="all")
    noise = instantiate(config.noise, _convert_="all")
    print(type(model).__name__, model.m, model.rounds, noise, sorted(config.estimators))
    print(instantiate(config.estimators.newton, _convert_="all").max_iterations)


main()
"""
CONFIG = """
defaults: [measurement: ranging, noise: gaussian, solver: [newton, fixed_point], _self_]
hydra: {output_subdir: null, run: {dir: .}, searchpath: [pkg://ipe_bench.conf]}
"""


def test_it_composes_our_configs_behind_its_own(tmp_path):
    (tmp_path / "my_conf" / "noise").mkdir(parents=True)
    (tmp_path / "app.py").write_text(APP)
    (tmp_path / "my_conf" / "config.yaml").write_text(CONFIG)
    (tmp_path / "my_conf" / "noise" / "gaussian.yaml").write_text(
        "_target_: builtins.dict\nown: 9\n"
    )
    # As an installation has them.
    shutil.copytree(ROOT / "ipe_bench", tmp_path / "ipe_bench")
    shutil.copytree(ROOT / "conf", tmp_path / "ipe_bench" / "conf", dirs_exist_ok=True)
    command = [
        sys.executable,
        "app.py",
        "measurement.rounds=7",
        "estimators.newton.max_iterations=9",
    ]
    variables = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, env=variables, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "is not available" not in done.stderr  # which Hydra says of a path
    assert done.stdout.splitlines() == ["Ranging 49 7 {'own': 9} ['fixed_point', 'newton']", "9"]
