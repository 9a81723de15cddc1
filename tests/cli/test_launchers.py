"""Where Hydra's launchers run the jobs of a sweep changes no number."""

from concurrent.futures import BrokenExecutor
from importlib.metadata import distributions

import pandas as pd
import pytest
from hydra._internal.hydra import Hydra

import ipe_bench as ib
from ipe_bench.cli.main import main
from ipe_bench.runs import results
from ipe_bench.runs.store import Store

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


def counted(monkeypatch, home, name):
    """Counts the calls of a function from here on."""
    calls = []
    inner = getattr(home, name)

    def outer(*arguments, **options):
        calls.append(arguments)
        return inner(*arguments, **options)

    monkeypatch.setattr(home, name, outer)
    return calls


def test_a_sweep_reads_its_folder_once_and_computes_once_what_its_jobs_share(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sweep = [*SWEEP[:3], "figures=none", "execution=serial", "output=out", "baseline=[linear_lse]"]
    sweep += ["error_scale=1,2,3", "solver=[newton],[fixed_point]"]
    written = counted(monkeypatch, Store, "write")
    assert main(["run", "-m", *sweep]) == 0
    assert len(written) == 3 * 4  # with the truth, and once what six jobs have in pairs
    read = counted(monkeypatch, results, "read_record")
    assert main(["run", "-m", *sweep]) == 0
    assert len(written) == 3 * 4
    assert len(read) == 3 * len(list((tmp_path / "out/runs").iterdir()))


def test_a_damaged_file_of_a_sweep_is_computed_once_again(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sweep = ["run", "-m", *SWEEP, "execution=serial", "output=out"]
    assert main(sweep) == 0
    before = rows("out")
    first = min((tmp_path / "out/trials").iterdir())
    first.write_bytes(first.read_bytes()[:-50])
    assert main(sweep) == 0
    assert len(list((tmp_path / "out/trials").glob("*.damaged-*"))) == 1
    pd.testing.assert_frame_equal(rows("out"), before, check_exact=True)


def test_a_killed_worker_of_a_launcher_is_one_line(tmp_path, monkeypatch, capsys):
    """That of joblib raises what Python's own pools do."""
    monkeypatch.chdir(tmp_path)

    def killed(*_: object, **__: object) -> None:
        raise BrokenExecutor("a worker stopped abruptly")

    monkeypatch.setattr(Hydra, "multirun", killed)
    assert main(["run", "-m", *SWEEP, "hydra/launcher=basic", "output=out"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("earlier results are intact: run the same command to resume")
