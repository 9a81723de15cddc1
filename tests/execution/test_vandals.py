"""Whatever a plugin does to its readings and its problem, the rows of all others have the same bits."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from vandals import Classy, Vandal, WrongR

from ipe_bench import Scenario
from ipe_bench.baselines import EnKF, LinearLSE
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import estimate_safely
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs.execution import Dask, Processes, Serial
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.solvers import Newton

OTHERS = {"linear_lse": LinearLSE(), "newton": Newton(), "enkf": EnKF(members=20)}
MESSAGES = {
    "readings": "ValueError: output array is read-only",
    "linearization": "ValueError: assignment destination is read-only",
    "R": "ValueError: output array is read-only",
    "nominal": "ValueError: output array is read-only",
}
"""Those that end as errors, and what is said of them."""
FAULTS = [*MESSAGES, "covariance"]
EXECUTIONS = [
    Serial(),
    pytest.param(Processes(2), marks=pytest.mark.campaign),
    pytest.param(Dask(2), marks=pytest.mark.campaign),
]


def scenario(noise=None) -> Scenario:
    return Scenario(Classy(0.02), noise or Gaussian(0.1), GaussianPrior(), error_scale=1.0)


def rows(folder: Path, label: str, noise: str = "gaussian") -> dict[str, np.ndarray]:
    """What is stored of one estimator (or of the truth), timings aside."""
    results = Results.read([folder])
    assert results.problems == []
    cell = next(c for c in results.stored.values() if c.label == label and c.names["noise"] == noise)
    columns = results.load(cell, None)
    return {name: np.asarray(columns[name]) for name in columns if name != "time_s"}


def assert_same(first: Path, second: Path) -> None:
    for label in ("truth", *OTHERS):
        before, after = rows(first, label), rows(second, label)
        assert before.keys() == after.keys()
        for name in before:
            np.testing.assert_array_equal(before[name], after[name], f"{label}: {name}")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    assert compute([scenario()], OTHERS, 8, folder, execution=Serial(), block_size=4) == ()
    return folder


@pytest.mark.parametrize("execution", EXECUTIONS, ids=repr)
@pytest.mark.parametrize("fault", FAULTS)
def test_one_vandal_changes_no_bit_of_the_others(tmp_path, undisturbed, execution, fault):
    if isinstance(execution, Dask):
        pytest.importorskip("distributed")
    estimators = {"vandal": Vandal(fault), **OTHERS}
    assert compute([scenario()], estimators, 8, tmp_path, execution=execution, block_size=4) == ()
    assert_same(undisturbed, tmp_path)
    vandal = rows(tmp_path, "vandal")
    if fault in MESSAGES:
        assert set(vandal["status"]) == {"error"}
        assert {m.split(";")[0] for m in vandal["message"]} == {MESSAGES[fault]}
    else:
        np.testing.assert_array_equal(vandal["error_a"], rows(undisturbed, "newton")["error_a"])


@pytest.mark.parametrize("execution", EXECUTIONS, ids=repr)
def test_a_wrong_R_concerns_its_own_scenario(tmp_path, undisturbed, execution):
    if isinstance(execution, Dask):
        pytest.importorskip("distributed")
    scenarios = [scenario(WrongR(0.1)), scenario()]
    assert compute(scenarios, OTHERS, 8, tmp_path, execution=execution, block_size=4) == ()
    assert_same(undisturbed, tmp_path)


def test_readings_of_the_user_are_left_alone_by_estimate():
    drawn = scenario().draw(0, 3)
    kept = drawn.z.copy()
    estimates = estimate_safely(Vandal("readings"), scenario().problem, drawn.z)
    assert (estimates.status == Status.ERROR).all()
    np.testing.assert_array_equal(drawn.z, kept)
    drawn.z[0, 0] = np.nan  # they are the user's to change


CTRL_C = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # which what runs in the background ignores
sys.path[:0] = {path!r}
from test_vandals import scenario
from vandals import Stopped
from ipe_bench.runs.run import compute

try:
    compute([scenario()], {{"stopped": Stopped()}}, 20, {folder!r})
except KeyboardInterrupt:
    sys.exit(130)
"""


def test_ctrl_c_stops_a_serial_run(tmp_path):
    path = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    code = CTRL_C.format(path=path, folder=str(tmp_path))
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=120).returncode == 130
