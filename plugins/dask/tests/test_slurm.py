"""The recipe for Slurm, on a Slurm: rows are those of one process, also where a job is killed."""

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest
import slurm

import ipe_bench as ib

COMMON = (
    "measurement=polynomial",
    "noise=gaussian",
    "noise.deviation=0.01",
    "solver=fixed_point",
    "baseline=linear_lse",
)
COMMON += ("figures=none", "block_size=10")
DASK = ("execution=dask", "execution.jobqueue=SLURMCluster", "execution.workers=2")
OPTIONS = 'execution.options={cores:1,memory:1GB,walltime:"00:10:00"}'
SUBMITIT = (
    "hydra/launcher=submitit_slurm",
    "hydra.launcher.timeout_min=10",
    "hydra.launcher.mem_gb=1",
)
SUBMITIT += ("hydra.launcher.cpus_per_task=1",)
JUDGED = ("trial", "error_c0", "error_c3", "deviation_c1", "status", "simulations", "nees")

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.skipif(bool(slurm.lacking()), reason=slurm.lacking() or "there is a Slurm"),
]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with slurm.started(tmp_path_factory.mktemp("slurm")) as environment:
        yield environment


def rows(folder: Path) -> pd.DataFrame:
    found = ib.load(folder).sort_values(["error_scale", "estimator", "trial"])
    return found[["error_scale", "estimator", *JUDGED]].reset_index(drop=True)


@pytest.fixture(scope="module")
def serial(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[int, tuple[float, ...]], pd.DataFrame]:
    """The rows of so many trials at these error scales, computed in this process."""

    def compute(trials: int, scales: tuple[float, ...]) -> pd.DataFrame:
        folder = tmp_path_factory.mktemp("serial")
        model, noise = ib.measurements.Polynomial(), ib.noise.Gaussian(0.01)
        scenarios = [ib.Scenario(model, noise, error_scale=scale) for scale in scales]
        estimators = {
            "fixed_point": ib.solvers.FixedPoint(),
            "linear_lse": ib.baselines.LinearLSE(),
        }
        ib.run(scenarios, estimators, trials, output=folder)
        return rows(folder)

    return compute


def start(folder: Path, environment: dict[str, str], *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "ipe_bench", "run", *words, *COMMON, "output=out"]
    quiet = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=quiet, stderr=quiet, text=True
    )


def seen(process: subprocess.Popen[str], environment: dict[str, str]) -> Iterator[dict[str, str]]:
    """The jobs that run, again and again while the command does."""
    while process.poll() is None:
        yield slurm.jobs(environment)
        time.sleep(0.3)


def kill_a_job(process: subprocess.Popen[str], environment: dict[str, str], folder: Path) -> str:
    """Kills one job of two once something is stored; returns its number."""
    for jobs in seen(process, environment):
        if len(jobs) == 2 and any(folder.glob("out/trials/*.parquet")):
            assert set(jobs.values()) == set(slurm.NODES)
            job = min(jobs)
            subprocess.run(["scancel", "--signal=KILL", "--full", job], env=environment, check=True)
            return job
    raise AssertionError(f"the command ended before there were two jobs: {process.communicate()}")


def test_a_killed_job_of_workers_loses_nothing(tmp_path, environment, serial):
    pytest.importorskip("dask_jobqueue")
    process = start(tmp_path, environment, *DASK, OPTIONS, "error_scale=3", "trials=1000")
    kill_a_job(process, environment, tmp_path)
    _, error = process.communicate()
    assert process.returncode == 0, error
    pd.testing.assert_frame_equal(rows(tmp_path / "out"), serial(1000, (3.0,)), check_exact=True)


@pytest.mark.skipif(
    importlib.util.find_spec("submitit") is None, reason="hydra-submitit-launcher is not installed"
)
def test_a_sweep_whose_job_was_killed_goes_on_where_it_was(tmp_path, environment, serial):
    """Without Slurm's accounting, submitit waits for ever for a job that was killed: the user ends
    the command."""
    words = ("-m", "error_scale=1,3", *SUBMITIT, "trials=1000")
    process = start(tmp_path, environment, *words)
    kill_a_job(process, environment, tmp_path)
    while slurm.jobs(environment):
        time.sleep(0.5)
    process.kill()
    process.communicate()
    before = len(list(tmp_path.glob("out/trials/*.parquet")))
    assert 0 < before < 2 * 3 * 100
    again = start(tmp_path, environment, *words)
    _, error = again.communicate()
    assert again.returncode == 0, error
    pd.testing.assert_frame_equal(
        rows(tmp_path / "out"), serial(1000, (1.0, 3.0)), check_exact=True
    )
