"""What is stored is found again, what is missing is computed, no half file is ever read, and
nothing is lost when files are merged."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shared.small_models import Bent
from shared.synthetic_store import Synthetic

from ipe_bench import Scenario, report
from ipe_bench.baselines import LinearLSE
from ipe_bench.cli.main import main
from ipe_bench.noise import Gaussian
from ipe_bench.runs import parts
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.runs.schedule import block_size_for, plan
from ipe_bench.runs.store import ResultKey, Store, gaps
from ipe_bench.solvers import Newton


def scenario(**changes) -> Scenario:
    return Scenario(Bent(0.02), Gaussian(0.1), **changes)


def rows(store: Store, cell: ResultKey) -> dict:
    """All columns but that of the clock, and the iterates of the first trials."""
    results = Results.read([store.directory])
    found, paths = (
        load(results.stored[cell.key])
        for load in (lambda c: results.load(c, None), results.load_history)
    )
    found |= {f"path_{name}": values for name, values in (paths or {}).items()}
    return {name: values for name, values in found.items() if name != "time_s"}


def blocks_of(*args, **kwargs) -> int:
    """How many blocks a run computes."""
    seen = []
    compute(*args, watch=lambda progress: seen.append(progress.tasks), **kwargs)
    return seen[-1]


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
    assert set(whole["path_trial"]) == set(range(20))
    for name in whole:
        np.testing.assert_array_equal(whole[name], cut[name])


def test_cells_of_one_name_are_told_apart_by_their_keys(tmp_path):
    """Two models that differ in a constant alone have the same names."""
    scenarios = [Scenario(Bent(bend), Gaussian(0.1)) for bend in (0.02, 0.03)]
    compute(scenarios, {"linear_lse": LinearLSE()}, 5, tmp_path)
    states = [state for state in Results.read([tmp_path]).cells if "truth" not in str(state.names)]
    keys = {ResultKey(one, "linear_lse", LinearLSE()).key for one in scenarios}
    assert {state.title[-9:] for state in states} == {f" (#{key[:6]})"[-9:] for key in keys}


def test_what_is_loaded_cannot_be_changed_for_others(tmp_path):
    compute([scenario()], {"linear_lse": LinearLSE()}, 5, tmp_path)
    results = Results.read([tmp_path])
    (cell, *_) = results.stored.values()
    with pytest.raises(ValueError, match="read-only"):
        results.load(cell, ["trial"])["trial"][:] = 0


def test_blocks_grow_with_the_number_of_trials_while_there_are_a_hundred():
    sizes = [
        block_size_for(trials) for trials in (0, 1, 1000, 49_999, 50_000, 75_000, 100_000, 10**7)
    ]
    assert sizes == [250, 250, 250, 250, 500, 750, 1000, 1000]


def test_the_key_follows_every_constant(tmp_path):
    scenarios = (
        scenario(),
        scenario(error_scale=2.0),
        scenario(seed=1),
        Scenario(Bent(0.03), Gaussian(0.1)),
    )
    assert (
        len(
            {ResultKey(s, "newton", e).key for s in scenarios for e in (Newton(), Newton(budget=9))}
        )
        == 8
    )
    assert (
        ResultKey(scenario(), "newton", Newton()).key
        == ResultKey(scenario(), "newton", Newton()).key
    )


def test_a_run_and_its_books_need_no_pandas(tmp_path):
    """Which a worker would take longer to load than to compute its first block."""
    script = f"""
import sys, ipe_bench as ib
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
compute([bench], {{"newton": ib.solvers.Newton()}}, 20, {str(tmp_path)!r}, block_size=10)
results = Results.read([{str(tmp_path)!r}])
sizes = [len(results.load(cell, None)["trial"]) for cell in results.current]
print(*sizes, "pandas" in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["20", "20", "False"]


# What is done, failed, missing and stale

RANGES = st.lists(
    st.tuples(st.integers(0, 40), st.integers(1, 20)).map(lambda r: (r[0], r[0] + r[1]))
)


@given(RANGES, st.integers(0, 30), st.integers(0, 30))
def test_gaps_are_what_no_range_holds(covered, start, length):
    held = np.zeros(200, dtype=bool)
    for first, last in covered:
        held[first:last] = True
    expected = [t for t in range(start, start + length) if not held[t]]
    found = gaps(covered, start, start + length)
    assert [t for first, last in found for t in range(first, last)] == expected
    assert all(first < last for first, last in found)


def test_a_refused_job_of_a_sweep_stays_in_the_books_until_it_is_accepted(
    tmp_path, capsys, monkeypatch
):
    output, sweep = (
        f"output={tmp_path}",
        ["run", "-m", "measurement=polynomial", "noise=gaussian", "trials=5"],
    )
    sweep += ["solver=[]", "baseline=[linear_lse]", "figures=none", "execution=serial", output]
    job = "measurement=polynomial, noise=gaussian, noise.deviation=1e-102"
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


# At the end of a run every result is one file with the same rows

TRIALS, BLOCK = 100, 3


def filled(folder: Path) -> Synthetic:
    """A store with a result in 34 small files, and those of its truth."""
    synthetic = Synthetic(folder)
    rng = np.random.default_rng(0)
    error = rng.standard_normal((TRIALS, 3))
    error[7] = np.nan
    status = np.where(np.arange(TRIALS) == 7, "nonfinite", "converged").astype(object)
    more = {"status": status, "solved": status == "converged", "extra_nis": rng.random(TRIALS)}
    more["message"] = np.where(np.arange(TRIALS) == 7, "out of range: ä", "").astype(object)
    synthetic.add(synthetic.scenario(), "mine", error, block=BLOCK, **more)
    synthetic.record(TRIALS)
    return synthetic


def everything(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """All rows of all results; nothing is wrong with any of them."""
    results = Results.read([folder])
    found = {key: results.load(cell, None) for key, cell in results.stored.items()}
    assert results.problems == []
    return found


def assert_same(found, expected) -> None:
    assert found.keys() == expected.keys()
    for key, rows in expected.items():
        assert found[key].keys() == rows.keys()
        for name, values in rows.items():
            assert found[key][name].dtype == values.dtype
            np.testing.assert_array_equal(found[key][name], values)


def merge(folder: Path) -> int:
    return sum(Store(folder).merge(key) for key in Results.read([folder]).stored)


def names(folder: Path, key: str = "") -> list[str]:
    return sorted(
        path.name.partition("-")[2] for path in (folder / "trials").glob(f"{key}*.parquet")
    )


@pytest.mark.parametrize("group", [parts.GROUP, 7])
def test_the_rows_are_the_same_in_one_file(tmp_path, monkeypatch, group):
    monkeypatch.setattr(parts, "GROUP", group)
    filled(tmp_path)
    expected = everything(tmp_path)
    assert merge(tmp_path) == 68
    assert names(tmp_path) == ["0-100.parquet"] * 2
    assert_same(everything(tmp_path), expected)
    assert merge(tmp_path) == 0


def test_a_file_that_the_disk_does_not_give_back_stands_for_none(tmp_path, monkeypatch):
    filled(tmp_path)
    before = names(tmp_path)
    write = parts.write_atomically

    def spoiled(path, written):
        write(path, written)
        path.write_bytes(path.read_bytes()[:-20] + 20 * b"x")

    monkeypatch.setattr(parts, "write_atomically", spoiled)
    for key in Results.read([tmp_path]).stored:
        with pytest.raises(parts.Unusable, match="damaged"):
            Store(tmp_path).merge(key)
    assert set(before) < set(names(tmp_path))


def test_a_file_of_several_groups_counts_its_trials_across_them(tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "GROUP", 7)
    filled(tmp_path)
    merge(tmp_path)
    path = next((tmp_path / "trials").glob("*-0-100.parquet"))
    part = parts.StoredPart.parse(path)
    assert part is not None
    (footer, _), *_, (_, last) = groups = list(part.groups())
    assert max(len(table) for _, table in groups) <= 7
    for wrong in ([table for _, table in groups[:-1]], [*(table for _, table in groups[1:]), last]):
        parts.write_groups(path, last.schema, wrong, footer)
        with pytest.raises(parts.Unusable, match="does not count from 0 to 100"):
            part.read()


def test_what_a_larger_file_holds_is_read_once_and_goes(tmp_path):
    filled(tmp_path)
    expected = everything(tmp_path)
    small = {path: path.read_bytes() for path in (tmp_path / "trials").iterdir()}
    merge(tmp_path)
    for path in list(small)[::2]:
        path.write_bytes(small[path])
    assert_same(everything(tmp_path), expected)
    assert merge(tmp_path) == len(list(small)[::2])
    assert_same(everything(tmp_path), expected)


@pytest.mark.parametrize("group", [parts.GROUP, 7])
def test_ranges_that_overlap_are_read_and_merged_once(tmp_path, monkeypatch, group):
    """Two runs with other sizes of blocks: trials 20 to 29 and 45 to 59 were computed twice."""
    monkeypatch.setattr(parts, "GROUP", group)
    error = np.random.default_rng(1).standard_normal((TRIALS, 3))
    synthetic = Synthetic(tmp_path)
    for start, stop in ((0, 30), (20, 50), (45, 60), (47, 52), (60, TRIALS)):
        synthetic.add(synthetic.scenario(), "mine", error[start:stop], start=start)
    synthetic.record(TRIALS)
    expected = everything(tmp_path)
    for rows in expected.values():
        np.testing.assert_array_equal(rows["trial"], np.arange(TRIALS))
    (cell,) = (c for c in synthetic.cells.values() if c.label == "mine")
    np.testing.assert_array_equal(expected[cell.key]["error_a"], error[:, 0])
    assert merge(tmp_path) > 0
    assert names(tmp_path) == ["0-100.parquet"] * 2
    assert_same(everything(tmp_path), expected)


KILLED = """
import os, pathlib, signal, sys
from ipe_bench.runs.execution import Serial
from ipe_bench.runs.results import Results
from ipe_bench.runs.store import Store
folder, moment = pathlib.Path(sys.argv[1]), int(sys.argv[2])
keys, count = set(Results.read([folder]).stored), 0

def deadly(call):
    def wrapped(*args, **more):
        global count
        count += 1
        if count == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        return call(*args, **more)
    return wrapped

os.fsync, os.replace, os.unlink = deadly(os.fsync), deadly(os.replace), deadly(os.unlink)
for key in keys:
    Store(folder).merge(key)
print(count)
"""


LATER = [pytest.param(moment, marks=pytest.mark.slow) for moment in (1, 2, 3, 5, 17, 38, 39, 60)]


@pytest.mark.parametrize("moment", [4, *LATER])
def test_killed_at_any_moment_every_trial_is_there_and_the_next_time_it_ends(tmp_path, moment):
    """Before and after a large file is on the disk, between its name and the first removal, and
    amid the removals."""
    filled(tmp_path)
    expected = everything(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path), str(moment)], capture_output=True, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert_same(everything(tmp_path), expected)
    merge(tmp_path)
    assert names(tmp_path) == ["0-100.parquet"] * 2
    assert_same(everything(tmp_path), expected)


def test_rows_that_go_away_for_good_are_missed(tmp_path, monkeypatch):
    monkeypatch.setattr("ipe_bench.runs.results._MOST_KEPT", 0)
    filled(tmp_path)
    results = Results.read([tmp_path])
    path = next((tmp_path / "trials").glob("*-9-12.parquet"))
    path.unlink()
    rows = results.load(results.stored[path.name.partition("-")[0]], None)
    assert len(rows["trial"]) == TRIALS - BLOCK
    (line,) = results.problems
    assert "went away while they were read" in line


def test_a_run_in_many_blocks_leaves_few_files_and_computes_nothing_again(tmp_path):
    estimators = {"linear_lse": LinearLSE()}
    compute([scenario()], estimators, 20, tmp_path, block_size=1)
    assert names(tmp_path) == ["0-20.parquet"] * 2
    assert blocks_of([scenario()], estimators, 22, tmp_path, block_size=1) == 2
    assert names(tmp_path) == ["0-22.parquet"] * 2
    assert report(tmp_path, figures="none").problems == ()


def test_blocks_lie_on_a_grid_of_their_own_wherever_trials_are_missing(tmp_path):
    class Lacking(Results):
        def __init__(self):
            """Without files."""

        def missing(self, key, trials):
            return [(5, 25), (28, 30)]

    cells = [ResultKey(scenario(), "newton", Newton())]
    tasks = plan(tmp_path, cells, Lacking(), 30, 10)
    assert [(task.start, task.stop) for task in tasks] == [(5, 10), (10, 20), (20, 25), (28, 30)]


def test_a_part_without_iterates_leaves_those_of_the_others_as_they_are():
    iterates = {"trial": np.array([0.0, 0.0]), "x_a": np.array([1.0, 2.0])}
    joined = parts.join_histories([iterates, None])
    assert joined is not None
    assert joined["x_a"].tolist() == [1.0, 2.0]
