"""Where Hydra's launchers run the jobs of a sweep changes no number."""

from importlib.metadata import distributions

import pandas as pd
import pytest

import ipe_bench as ib
from ipe_bench.cli.main import main

LAUNCHERS = {"joblib": "hydra-joblib-launcher", "submitit_local": "hydra-submitit-launcher"}
EACH = ["basic", *(pytest.param(launcher, marks=pytest.mark.slow) for launcher in LAUNCHERS)]
SWEEP = ["measurement=polynomial", "noise=gaussian", "trials=12", "error_scale=1,10"]
SWEEP += ["solver=[newton]", "baseline=[linear_lse]", "figures=none"]


def needs(launcher: str) -> None:
    if launcher != "basic" and LAUNCHERS[launcher] not in {found.name for found in distributions()}:
        pytest.skip(f"needs {LAUNCHERS[launcher]}")


def rows(folder: str) -> pd.DataFrame:
    found = ib.load(folder).drop(columns="time_s")
    return found.sort_values(["seed", "error_scale", "estimator", "trial"], ignore_index=True)


@pytest.mark.parametrize("launcher", EACH)
@pytest.mark.filterwarnings("default")  # what launchers use of their libraries is no error of ours
def test_rows_are_those_of_a_serial_sweep(launcher, tmp_path, monkeypatch, capsys):
    needs(launcher)
    monkeypatch.chdir(tmp_path)
    assert main(["run", "-m", *SWEEP, "execution=serial", "output=serial"]) == 0
    assert (
        main(["run", "-m", *SWEEP, f"hydra/launcher={launcher}", f"output={tmp_path}/launched"])
        == 0
    )
    serial = rows("serial")
    assert len(serial) == 2 * 12 * 2
    pd.testing.assert_frame_equal(rows("launched"), serial, check_exact=True)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", EACH)
@pytest.mark.filterwarnings("default")
def test_a_job_that_is_refused_is_told_and_stands_in_the_books(
    launcher, tmp_path, monkeypatch, capsys
):
    needs(launcher)
    monkeypatch.chdir(tmp_path)
    # Workers of joblib's that are there already have another working folder.
    sweep = [*SWEEP, "execution=serial", "noise.deviation=0.01,1e-150", f"output={tmp_path}/out"]
    sweep.append(f"hydra/launcher={launcher}")
    assert main(["run", "-m", *sweep]) == 2
    assert "noise.deviation=1e-150 and 1 more)" in capsys.readouterr().err.splitlines()[-1]
    assert main(["status", "out"]) == 1
    assert capsys.readouterr().out.count("refused: ") == 2
