"""What is stored is found again, what is missing is computed, and no half file is ever read."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
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
from ipe_bench.runs.parts import as_array
from ipe_bench.runs.results import Results, require_results
from ipe_bench.runs.run import compute
from ipe_bench.runs.schedule import Task, _recalled, block_size_for
from ipe_bench.runs.store import ResultKey, Store, gaps
from ipe_bench.solvers import FixedPoint, Newton


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


def test_one_more_estimator_computes_only_itself(tmp_path):
    compute([scenario()], {"linear_lse": LinearLSE()}, 20, tmp_path)
    before = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "trials").iterdir()}
    compute([scenario()], {"linear_lse": LinearLSE(), "fixed_point": FixedPoint()}, 20, tmp_path)
    after = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "trials").iterdir()}
    assert len(after) == len(before) + 1
    assert before.items() <= after.items()


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


def test_a_process_keeps_what_it_found_out_of_the_components_of_its_tasks(tmp_path):
    """Tasks come as copies; what one of them has traced serves the next."""
    task = Task(tmp_path, (ResultKey(scenario()), ResultKey(scenario(), "newton", Newton())), 0, 10)
    first, second = (_recalled(pickle.loads(pickle.dumps(task))) for _ in range(2))
    assert all(a is b for a, b in zip(first, second, strict=True))
    assert [cell.key for cell in second] == [cell.key for cell in task.cells]


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


def test_a_changed_source_makes_another_key(tmp_path):
    code = """
from dataclasses import dataclass
from ipe_bench.solvers import FixedPoint

@dataclass(frozen=True)
class Mine(FixedPoint):
    pass
"""
    script = "from ipe_bench.runs.provenance import fingerprint; from mine import Mine"
    script += "; print(fingerprint([Mine()])['source'])"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}

    def digest(source: str) -> str:
        (tmp_path / "mine.py").write_text(source)
        return subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
        ).stdout

    assert digest(code) != digest(code + "\nFACTOR = 2\n")
    assert digest(code) == digest(code)


def test_the_footer_says_what_the_file_holds(tmp_path):
    compute([scenario()], {"linear_lse": LinearLSE()}, 10, tmp_path)
    footers = [cell.footer for cell in Results.read([tmp_path]).stored.values()]
    assert {f["names"]["estimator"] for f in footers} == {"truth", "linear_lse"}
    assert all(f["identity"]["scenario"]["measurement"]["bend"] == 0.02 for f in footers)
    assert all(set(f["versions"]) >= {"ipe_bench"} for f in footers)


@pytest.mark.parametrize("cut", [slice(None), slice(3, 11), slice(0, 0)])
def test_columns_are_read_as_arrow_reads_them(tmp_path, cut):
    rng = np.random.default_rng(1)
    columns = {
        "number": pa.array(rng.normal(size=20)),
        "count": pa.array(np.arange(20)),
        "small": pa.array(np.arange(20, dtype=np.int8)),
        "flag": pa.array(rng.random(20) < 0.5),
        "text": pa.array([f"trial {i}" for i in range(20)]),
        "gaps": pa.array([None if i % 3 == 0 else float(i) for i in range(20)]),
        "rare": pa.array([None if i % 3 == 0 else str(i) for i in range(20)]),
    }
    table = pa.table(columns)
    path = tmp_path / "columns.parquet"
    pq.write_table(table, path)
    read = pq.read_table(path).slice(cut.start or 0, len(range(20)[cut]))
    joined = pa.concat_tables([read, read])
    for name in columns:
        for part in (read, joined):
            expected, found = part[name].to_numpy(), as_array(part[name])
            assert len(expected) == len(found)
            if len(expected):
                assert found.dtype == expected.dtype
                np.testing.assert_array_equal(found, expected)


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


def test_a_complete_run_is_complete(tmp_path, capsys):
    compute([scenario()], {"linear_lse": LinearLSE()}, 20, tmp_path, block_size=10)
    results = Results.read([tmp_path])
    assert results.problems == []
    assert [(c.names["estimator"], c.expected, c.done) for c in results.cells] == [
        ("truth", 20, 20),
        ("linear_lse", 20, 20),
    ]
    assert status([str(tmp_path)]) == 0
    assert "complete" in capsys.readouterr().out


def test_a_block_that_is_gone_is_missing_and_a_cut_one_is_damaged(tmp_path, capsys):
    compute([scenario()], {"linear_lse": LinearLSE()}, 30, tmp_path, block_size=10)
    gone, cut = sorted((tmp_path / "trials").glob("*.parquet"))
    gone.unlink()
    cut.write_bytes(cut.read_bytes()[:100])
    results = Results.read([tmp_path])
    assert list(results.damaged) == [cut]
    assert [(c.done, c.missing, c.failed) for c in results.cells] == [(0, 30, 0)] * 2
    assert status([str(tmp_path)]) == 1
    assert "damaged" in capsys.readouterr().out
    compute([scenario()], {"linear_lse": LinearLSE()}, 30, tmp_path, block_size=10)
    assert Results.read([tmp_path]).problems == []
    assert len(list(cut.parent.glob(f"{cut.stem}.damaged-*"))) == 1


def test_results_of_other_source_are_stale_and_not_done(tmp_path, monkeypatch):
    compute([scenario()], {"linear_lse": LinearLSE()}, 20, tmp_path)
    original = ipe_bench.runs.provenance.fingerprint
    changed = lambda parts: {**original(parts), "source": "a fix"}  # noqa: E731
    monkeypatch.setattr("ipe_bench.runs.store.fingerprint", changed)
    monkeypatch.setattr("ipe_bench.runs.schedule.fingerprint", changed)
    compute([scenario()], {"linear_lse": LinearLSE()}, 10, tmp_path)
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
