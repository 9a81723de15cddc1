"""What is stored is found again, what is missing is computed, and no half file is ever read."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small_models import Bent

from ipe_bench import Scenario, load, run
from ipe_bench.baselines import LinearLSE
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs.parts import as_array
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.runs.schedule import Task, _recalled, block_size_for
from ipe_bench.runs.store import ResultKey, Store
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


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_a_damaged_file_is_set_aside_and_computed_again(tmp_path, damage):
    estimators = {"linear_lse": LinearLSE()}
    compute([scenario()], estimators, 10, tmp_path)
    cell = ResultKey(scenario(), "linear_lse", LinearLSE())
    path = next((tmp_path / "trials").glob(f"{cell.key}-*.parquet"))
    whole = rows(Store(tmp_path), cell)
    data = path.read_bytes()
    flipped = data[:4] + bytes(b ^ 255 for b in data[4:200]) + data[200:]
    path.write_bytes(data[:200] if damage == "truncated" else flipped)
    compute([scenario()], estimators, 10, tmp_path)
    assert len(list(path.parent.glob(f"{path.stem}.damaged-*"))) == 1
    for name, values in rows(Store(tmp_path), cell).items():
        np.testing.assert_array_equal(values, whole[name])


def test_the_footer_says_what_the_file_holds(tmp_path):
    compute([scenario()], {"linear_lse": LinearLSE()}, 10, tmp_path)
    footers = [cell.footer for cell in Results.read([tmp_path]).stored.values()]
    assert {f["names"]["estimator"] for f in footers} == {"truth", "linear_lse"}
    assert all(f["identity"]["scenario"]["measurement"]["bend"] == 0.02 for f in footers)
    assert all(set(f["versions"]) >= {"ipe_bench"} for f in footers)


def test_a_raising_estimator_is_a_status_and_the_others_are_complete(tmp_path):
    from ipe_bench.estimators.base import Estimator

    class Broken(Estimator):
        def estimate(self, problem, z, *, history=False):
            raise RuntimeError("out of order")

    from dataclasses import dataclass

    frame = run(
        scenario(), {"linear_lse": LinearLSE(), "broken": dataclass(frozen=True)(Broken)()}, 10, output=tmp_path
    )
    rates = frame[frame["parameter"] == "all"].set_index("estimator")["converged"]
    assert rates["linear_lse"] == 1.0
    assert rates["broken"] == 0.0
    results = Results.read([tmp_path])
    stored = results.load(next(c for c in results.stored.values() if c.label == "broken"), None)
    assert set(stored["status"]) == {"error"}
    assert set(stored["message"]) == {"RuntimeError: out of order"}


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


@pytest.mark.slow
def test_killed_and_run_again_it_ends_as_if_never_killed(tmp_path):
    command = [sys.executable, "-m", "ipe_bench", "run", "error_scale=33", "trials=600", "block_size=20"]
    reference, killed = tmp_path / "reference", tmp_path / "killed"
    subprocess.run([*command, f"output={reference}"], check=True, capture_output=True)
    for wait in (4.0, 5.0):
        process = subprocess.Popen([*command, f"output={killed}"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        time.sleep(wait)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    subprocess.run([*command, f"output={killed}"], check=True, capture_output=True)
    ours, theirs = load(killed), load(reference)
    pd.testing.assert_frame_equal(ours.drop(columns="time_s"), theirs.drop(columns="time_s"))
