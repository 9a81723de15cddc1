"""What is stored is found again, what is missing is computed, and no half file is ever read."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_models import Bent

from ipe_bench import Scenario
from ipe_bench.baselines import LinearLSE
from ipe_bench.cli.main import main
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.runs.schedule import block_size_for
from ipe_bench.runs.store import ResultKey, Store, gaps
from ipe_bench.solvers import Newton


def scenario(**changes) -> Scenario:
    return Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior(), **{"error_scale": 1.0, **changes})


def rows(store: Store, cell: ResultKey) -> dict:
    results = Results.read([store.directory])
    found = results.load(results.stored[cell.key], None)
    return {name: values for name, values in found.items() if name != "time_s"}


class Counting:
    """Watches how many blocks a run computes."""

    def __init__(self) -> None:
        self.tasks = None

    def __call__(self, progress) -> None:
        self.tasks = progress.tasks


def blocks_of(*args, **kwargs) -> int:
    counting = Counting()
    compute(*args, watch=counting, **kwargs)
    return counting.tasks


def test_a_second_run_computes_nothing_and_more_trials_only_the_difference(tmp_path):
    estimators = {"linear_lse": LinearLSE()}
    assert blocks_of([scenario()], estimators, 20, tmp_path, block_size=10) == 2
    assert blocks_of([scenario()], estimators, 20, tmp_path, block_size=10) == 0
    assert blocks_of([scenario()], estimators, 30, tmp_path, block_size=10) == 1


@pytest.mark.parametrize("block_size", [1, 7, 100])
def test_trials_are_the_same_bits_for_any_block_size(tmp_path, block_size):
    estimators = {"newton": Newton()}
    compute([scenario()], estimators, 23, tmp_path / "whole", block_size=23)
    compute([scenario()], estimators, 23, tmp_path / "cut", block_size=block_size)
    cell = ResultKey(scenario(), "newton", Newton())
    whole, cut = (rows(Store(tmp_path / name), cell) for name in ("whole", "cut"))
    for name in whole:
        np.testing.assert_array_equal(whole[name], cut[name])


def test_blocks_grow_with_the_number_of_trials_while_there_are_a_hundred():
    sizes = [block_size_for(trials) for trials in (0, 1, 1000, 49_999, 50_000, 75_000, 100_000, 10**7)]
    assert sizes == [250, 250, 250, 250, 500, 750, 1000, 1000]


def test_the_key_follows_every_constant(tmp_path):
    keys = {
        ResultKey(s, "newton", e).key
        for s in (
            scenario(),
            scenario(error_scale=2.0),
            scenario(seed=1),
            Scenario(Bent(0.03), Gaussian(0.1), GaussianPrior(), 1.0),
        )
        for e in (Newton(), Newton(tolerance=1e-7))
    }
    assert len(keys) == 8
    assert ResultKey(scenario(), "newton", Newton()).key == ResultKey(scenario(), "newton", Newton()).key


def test_a_run_and_its_books_need_no_pandas(tmp_path):
    """Which a worker would take longer to load than to compute its first block."""
    script = f"""
import sys, ipe_bench as ib
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
compute([bench], {{"newton": ib.solvers.Newton()}}, 20, {str(tmp_path)!r}, block_size=10)
results = Results.read([{str(tmp_path)!r}])
print(*[len(results.load(cell, None)["trial"]) for cell in results.current], "pandas" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["20", "20", "False"]


# What is done, failed, missing and stale

RANGES = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 20)).map(lambda r: (r[0], r[0] + r[1])))


@given(RANGES, st.integers(0, 30), st.integers(0, 30))
def test_gaps_are_what_no_range_holds(covered, start, length):
    held = np.zeros(200, dtype=bool)
    for first, last in covered:
        held[first:last] = True
    expected = [t for t in range(start, start + length) if not held[t]]
    found = gaps(covered, start, start + length)
    assert [t for first, last in found for t in range(first, last)] == expected
    assert all(first < last for first, last in found)


def test_a_refused_job_of_a_sweep_stays_in_the_books_until_it_is_accepted(tmp_path, capsys, monkeypatch):
    output, sweep = f"output={tmp_path}", ["run", "-m", "measurement=polynomial", "noise=gaussian", "trials=5"]
    sweep += ["solver=[]", "baseline=[linear_lse]", "figures=none", "execution=serial", output]
    job = "measurement=polynomial noise=gaussian noise.deviation=1e-102"
    assert main([*sweep, "noise.deviation=0.02,1e-102"]) == 2
    assert f"choose another scale of the noise (refused: {job})" in capsys.readouterr().err
    assert main(["status", str(tmp_path)]) == 1
    assert f"refused: {job}: noise=gaussian" in capsys.readouterr().out.replace("\n", "")
    results = Results.read([tmp_path])
    assert (results.complete, results.expected) == (2, 4)
    assert f"refused: {job}" in (tmp_path / "report.html").read_text(encoding="utf-8")
    monkeypatch.setattr("ipe_bench.runs.run.LARGEST", 1e300)
    assert main([*sweep, "noise.deviation=0.02,1e-102"]) == 0
    results = Results.read([tmp_path])
    assert (results.complete, results.expected, results.problems) == (4, 4, [])
