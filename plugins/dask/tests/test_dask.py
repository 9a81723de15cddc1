"""A cluster computes the rows of one process, also where one of its workers dies."""

import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("distributed")
sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_dask import Dask

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.runs.execution import Execution, Serial

pytestmark = pytest.mark.plugin


@dataclass(frozen=True)
class KillsOnce(ib.Estimator):
    """Kills its process, until it has done so once."""

    mark: str

    def estimate(self, problem, z, *, history=False):
        if not Path(self.mark).exists():
            Path(self.mark).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return ib.baselines.LinearLSE().estimate(problem, z)


def rows(folder: Path, execution: Execution, **more: ib.Estimator) -> pd.DataFrame:
    scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    estimators = {"linear_lse": ib.baselines.LinearLSE(), "newton": ib.solvers.Newton(), **more}
    ib.run(scenario, estimators, 40, output=folder, execution=execution, block_size=10)
    found = (
        ib.load(folder)
        .drop(columns="time_s")
        .sort_values(["estimator", "trial"], ignore_index=True)
    )
    return found[found["estimator"].isin(["linear_lse", "newton"])].reset_index(drop=True)


def test_rows_are_those_of_one_process_also_where_a_worker_is_killed(tmp_path):
    alone = rows(tmp_path / "serial", Serial())
    assert len(alone) == 80
    pd.testing.assert_frame_equal(rows(tmp_path / "dask", Dask(2)), alone, check_exact=True)
    killed = rows(tmp_path / "killed", Dask(2), killer=KillsOnce(str(tmp_path / "mark")))
    assert (tmp_path / "mark").exists()
    pd.testing.assert_frame_equal(killed, alone, check_exact=True)


def test_a_missing_library_is_said_in_a_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UserError, match="Dask is not installed; pip install distributed"):
        list(Dask(workers=3).run(None, [None]))  # type: ignore[arg-type]


def test_an_address_goes_with_no_other_option():
    with pytest.raises(UserError, match="leave out either"):
        Dask(address="tcp://10.0.0.1:8786", workers=2)
