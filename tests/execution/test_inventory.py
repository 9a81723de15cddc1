"""What is done, failed, missing and stale adds up, whatever the order in which it came about."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_models import Bent

import ipe_bench.runs.provenance
from ipe_bench import Scenario
from ipe_bench.baselines import LinearLSE
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.main import main
from ipe_bench.cli.status import main as status
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs.results import Results, require_results
from ipe_bench.runs.run import compute
from ipe_bench.runs.store import gaps

SCENARIO = Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior(), 1.0)
ESTIMATORS = {"linear_lse": LinearLSE()}
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


def test_a_complete_run_is_complete(tmp_path, capsys):
    compute([SCENARIO], ESTIMATORS, 20, tmp_path, block_size=10)
    results = Results.read([tmp_path])
    assert results.problems == []
    assert [(c.names["estimator"], c.expected, c.done) for c in results.cells] == [
        ("truth", 20, 20),
        ("linear_lse", 20, 20),
    ]
    assert status([str(tmp_path)]) == 0
    assert "complete" in capsys.readouterr().out


def test_a_block_that_is_gone_is_missing_and_a_cut_one_is_damaged(tmp_path, capsys):
    compute([SCENARIO], ESTIMATORS, 30, tmp_path, block_size=10)
    gone, cut = sorted((tmp_path / "trials").glob("*.parquet"))
    gone.unlink()
    cut.write_bytes(cut.read_bytes()[:100])
    results = Results.read([tmp_path])
    assert list(results.damaged) == [cut]
    assert [(c.done, c.missing, c.failed) for c in results.cells] == [(0, 30, 0)] * 2
    assert status([str(tmp_path)]) == 1
    assert "damaged" in capsys.readouterr().out
    compute([SCENARIO], ESTIMATORS, 30, tmp_path, block_size=10)
    assert Results.read([tmp_path]).problems == []
    assert len(list(cut.parent.glob(f"{cut.stem}.damaged-*"))) == 1


def test_results_of_other_source_are_stale_and_not_done(tmp_path, monkeypatch):
    compute([SCENARIO], ESTIMATORS, 20, tmp_path)
    original = ipe_bench.runs.provenance.fingerprint
    changed = lambda parts: {**original(parts), "source": "a fix"}  # noqa: E731
    monkeypatch.setattr("ipe_bench.runs.store.fingerprint", changed)
    monkeypatch.setattr("ipe_bench.runs.schedule.fingerprint", changed)
    compute([dataclasses.replace(SCENARIO)], ESTIMATORS, 10, tmp_path)
    assert [(c.expected, c.done, c.stale) for c in Results.read([tmp_path]).cells] == [(10, 10, 20), (10, 10, 20)]


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


def test_a_folder_without_results_is_a_mistake(tmp_path):
    with pytest.raises(UserError, match="holds no results"):
        require_results([tmp_path])
