"""At the end of a run every result is one file with the same rows; nothing is lost on the way, whatever happens."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_models import Bent
from synthetic_store import Synthetic

from ipe_bench import Scenario, report
from ipe_bench.baselines import LinearLSE
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs import parts
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.runs.store import Store

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
    return sorted(path.name.partition("-")[2] for path in (folder / "trials").glob(f"{key}*.parquet"))


def test_the_rows_are_the_same_in_one_file(tmp_path):
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


def test_ranges_that_overlap_are_read_and_merged_once(tmp_path):
    """Two runs with other sizes of blocks: trials 20 to 29 and 45 to 59 were computed twice."""
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


LATER = [pytest.param(moment, marks=pytest.mark.slow) for moment in (2, 5, 17, 38, 39, 60)]


@pytest.mark.parametrize("moment", [1, 3, 4, *LATER])
def test_killed_at_any_moment_every_trial_is_there_and_the_next_time_it_ends(tmp_path, moment):
    """Before and after a large file is on the disk, between its name and the first removal, and amid the removals."""
    filled(tmp_path)
    expected = everything(tmp_path)
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), str(moment)], capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    assert_same(everything(tmp_path), expected)
    merge(tmp_path)
    assert names(tmp_path) == ["0-100.parquet"] * 2
    assert_same(everything(tmp_path), expected)


def test_rows_that_go_away_for_good_are_missed(tmp_path):
    filled(tmp_path)
    results = Results.read([tmp_path])
    path = next((tmp_path / "trials").glob("*-9-12.parquet"))
    path.unlink()
    rows = results.load(results.stored[path.name.partition("-")[0]], None)
    assert len(rows["trial"]) == TRIALS - BLOCK
    (line,) = results.problems
    assert "went away while they were read" in line


def test_a_run_in_many_blocks_leaves_few_files_and_computes_nothing_again(tmp_path):
    scenario, estimators = Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior(), 1.0), {"linear_lse": LinearLSE()}
    compute([scenario], estimators, 20, tmp_path, block_size=1)
    assert names(tmp_path) == ["0-20.parquet"] * 2
    seen = []
    compute([scenario], estimators, 22, tmp_path, block_size=1, watch=lambda p: seen.append(p.tasks))
    assert max(seen) == 2
    assert names(tmp_path) == ["0-22.parquet"] * 2
    assert report(tmp_path, figures="none").problems == ()
