"""Sums over portions of rows are those over all rows, as NumPy has them, however the rows are portioned and stored."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm
from synthetic_store import Pretender, Seeker, Synthetic

import ipe_bench as ib
from ipe_bench.runs.results import CHUNK
from ipe_bench.runs.store import ResultKey
from ipe_bench.statistics import analyse, summarize
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.running import Bins, Mean, Scatter, Squares
from ipe_bench.statistics.sums import Beside

TRIALS = CHUNK + 600
RNG = np.random.default_rng


def portions(rng: np.random.Generator, rows: int) -> list[slice]:
    edges = [0, *np.sort(rng.choice(np.arange(1, rows), 6, replace=False)).tolist(), rows]
    return [slice(*edge) for edge in pairwise(edges)]


@pytest.mark.parametrize("offset", [0.0, 1e8])
def test_scatter_is_the_covariance_of_numpy_however_far_from_zero(offset):
    rng = RNG(0)
    values, used = rng.standard_normal((3, 500)) + offset, rng.random(500) < 0.7
    values[1] += 2 * values[0]
    found = Scatter(3)
    for part in portions(rng, 500):
        found.add(values[:, part], used[part])
    assert found.count == used.sum()
    assert found.mean == pytest.approx(values[:, used].mean(axis=1), rel=1e-14)
    assert found.products / (found.count - 1) == pytest.approx(np.cov(values[:, used]), rel=1e-6 if offset else 1e-12)


@pytest.mark.parametrize("size", [1e-150, 1.0, 1e150])
def test_squares_have_the_mean_and_deviation_of_numpy_at_any_size(size):
    """At 1e-150 and 1e150 the squares are numbers, and their squares are not."""
    rng = RNG(1)
    values = rng.standard_normal((2, 400)) ** 4
    values[:, 300:] *= 50
    found = Squares(2)
    for part in portions(rng, 400):
        found.add(size**2 * values[:, part])
    assert found.size == pytest.approx(size**2 * values.max(axis=1))
    assert found.mean * values.max(axis=1) == pytest.approx(values.mean(axis=1), rel=1e-12)
    assert found.deviation * values.max(axis=1) == pytest.approx(values.std(axis=1, ddof=1), rel=1e-12)


@pytest.mark.parametrize(("rows", "most"), [(5, 7), (100, 7), (101, 100), (10_000, 64)])
def test_bins_hold_every_row_once_in_its_order(rows, most):
    rng = RNG(2)
    values = rng.integers(1, 100, (2, rows)).astype(float)
    found = Bins(2, rows, most)
    for part in portions(rng, rows) if rows > 10 else [slice(0, rows)]:
        found.add(values[:, part])
    assert len(found.sums) == min(rows, most)
    edges = [*found.edges, rows]
    assert max(np.diff(edges)) - min(np.diff(edges)) <= 1
    expected = [values[:, a:b].sum(axis=1) for a, b in pairwise(edges)]
    np.testing.assert_array_equal(found.sums, expected)


def test_a_mean_of_nothing_is_not_a_number():
    mean = Mean(2)
    mean.add(np.ones((2, 3)), np.zeros(3, dtype=bool))
    assert np.isnan(mean.value).all()


def test_the_truth_is_found_beside_the_estimates_whatever_is_missing_of_either():
    rng = RNG(3)
    known = np.flatnonzero(rng.random(1000) < 0.8)
    chunks = [{"trial": part, "a": part * 2.0} for part in np.array_split(known, [7, 300, 301, 650])]
    beside = Beside(iter(chunks))
    wanted = np.flatnonzero(rng.random(1200) < 0.6)
    for part in np.array_split(wanted, [50, 51, 400]):
        found = beside.at(part, ("a", "b"))
        np.testing.assert_array_equal(found["a"], np.where(np.isin(part, known), part * 2.0, np.nan))
        assert np.isnan(found["b"]).all()


# A store of several portions -----------------------------------------------------------------------------------------


def fill(folder: Path, blocks: tuple[int, int, int]) -> Synthetic:
    """Two estimators, a filter-like one and one that seeks a root, on two seeds; every 25th trial has no finite
    estimate, others are not solved, and the truth of some is not stored. Cut into blocks of three sizes."""
    synthetic = Synthetic(folder)
    for seed in (0, 4):
        scenario = synthetic.scenario(seed=seed)
        bound = synthetic.bound(scenario)
        rng = RNG(seed)
        for j, (label, estimator) in enumerate({"root": Seeker(), "plain": Pretender(1)}.items()):
            error = 1.1 * bound * rng.standard_normal((TRIALS, 3)) + 0.1 * bound
            lost = np.arange(TRIALS) % 25 == j
            error[lost] = np.nan
            status = np.where(lost, "nonfinite", "converged").astype(object)
            deviation = bound * rng.uniform(0.8, 1.2, (TRIALS, 3))
            solved = ~lost & (rng.random(TRIALS) < 0.9)
            more = {"status": status, "solved": solved, "deviation": deviation, "time_s": rng.random(TRIALS)}
            more["crlb_distance"] = ((error / bound) ** 2).sum(axis=1)
            more["nees"] = ((error / deviation) ** 2).sum(axis=1)
            more["success"] = np.nan_to_num(more["crlb_distance"], nan=1e9) < 16
            synthetic.add(scenario, label, error, block=blocks[j], estimator=estimator, **more)
        truth = ResultKey(scenario)
        for path in synthetic.store.trials.glob(f"{truth.key}-*"):
            path.unlink()
        drawn = rng.uniform(0.5, 1.5, (4, TRIALS, 3))
        names = [p.name for p in scenario.measurement.parameters]
        facts = {"trial": np.arange(TRIALS), "curvature_intrinsic": np.where(np.arange(TRIALS) < 5, 0.1, np.nan)}
        for kind, values in zip(("x", "crlb", "bayes", "linear_error"), drawn, strict=True):
            facts |= {f"{kind}_{name}": values[:, i] * bound[i] for i, name in enumerate(names)}
        for at in range(0, TRIALS, blocks[2]):
            part = slice(at, min(at + blocks[2], TRIALS))
            synthetic.store.write(truth, at, part.stop, {k: v[part] for k, v in facts.items()})
    synthetic.record(TRIALS)
    return synthetic


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("running")
    fill(folder, (TRIALS, 5000, 9000))
    return folder


@pytest.fixture(scope="module")
def analysis(store) -> Analysis:
    return analyse([store])


def test_every_sum_is_that_of_pandas_over_all_rows_at_once(store, analysis):
    """Each formula once more, over whole columns."""
    summary = analysis.summary.set_index(["estimator", "parameter"])
    rows = ib.load(store)
    sizes = {"a": 1.0, "b": 10.0, "c": 0.1}
    common = rows.groupby(["seed", "trial"])["solved"].transform("all")
    linear = 0.2 / 2
    for label in ("root", "plain"):
        mine = rows[rows["estimator"] == label]
        solved, every = mine[mine["solved"]], mine[mine["solved"] & common[mine.index]]
        squares = mine[[f"error_{n}" for n in sizes]] ** 2
        together = squares.mean(axis=1, skipna=False) ** 0.5 / linear
        overall = summary.loc[label, "all"]
        limited = together.fillna(1e300).quantile([0.5, 0.95])
        assert [overall["median_abs_error"], overall["q95_abs_error"]] == pytest.approx(list(limited), rel=1e-12)
        for name, size in sizes.items():
            found, e = summary.loc[label, name], solved[f"error_{name}"]
            ratio = (mine[f"error_{name}"] / mine[f"deviation_{name}"]).abs()
            expected = {
                "bias": size * e.mean(),
                "std": size * e.std(),
                "rmse": size * np.sqrt((e**2).mean()),
                "rmse_common": size * np.sqrt((every[f"error_{name}"] ** 2).mean()),
                "rmse_all": np.inf,
                "crlb": size * np.sqrt((solved[f"crlb_{name}"] ** 2).mean()),
                "bayes_bound": size * np.sqrt((solved[f"bayes_{name}"] ** 2).mean()),
                "reported": size * np.sqrt((solved[f"deviation_{name}"] ** 2).mean()),
                "nees": (ratio[mine["solved"]] ** 2).mean(),
                "coverage95": (ratio <= norm.isf(0.025)).mean(),
                "median_abs_error": size * mine[f"error_{name}"].abs().fillna(1e300).quantile(0.5),
                "q95_abs_error": size * mine[f"error_{name}"].abs().fillna(1e300).quantile(0.95),
                "curvature_intrinsic": 0.1,
            }
            if label == "root":
                compensation = ((e - solved[f"linear_error_{name}"]) ** 2).mean()
                expected["eq_14"] = size * np.sqrt(linear**2 + compensation)
            for column, value in expected.items():
                assert found[column] == pytest.approx(value, rel=1e-11), (label, name, column)
            assert found["rmse_low"] < found["rmse"] < found["rmse_high"]


def test_correlations_are_those_of_pandas(store, analysis):
    rows = ib.load(store)
    for label, part in analysis.correlations.groupby("estimator"):
        mine = rows[(rows["estimator"] == label) & rows["solved"]]
        expected = mine[[f"error_{n}" for n in "abc"]].corr().to_numpy()
        assert part["value"].to_numpy().reshape(3, 3) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_no_bit_depends_on_how_rows_are_cut_into_files(analysis, tmp_path):
    fill(tmp_path, (777, TRIALS, 1234))
    pd.testing.assert_frame_equal(summarize([tmp_path]), analysis.summary, check_exact=True)


def test_matrices_are_what_is_stored_and_cannot_be_changed(store):
    from ipe_bench.statistics.collect import collect
    from ipe_bench.statistics.sample import Sample, Shared

    collection = collect([store])
    group = collection.groups[0]
    sample = Sample.load(collection, group, Shared.among(collection, collection.groups))
    rows = ib.load(store)
    rows = rows[rows["estimator"] == group.estimator]
    for kind in ("error", "deviation", "crlb", "linear_error"):
        expected = rows[[f"{kind}_{n}" for n in "abc"]].to_numpy()
        np.testing.assert_array_equal(getattr(sample, kind), expected)
    np.testing.assert_array_equal(sample.ids, rows[["seed", "trial"]].to_numpy())
    np.testing.assert_array_equal(sample.truth["curvature_intrinsic"], rows["curvature_intrinsic"].to_numpy())
    assert np.isnan(sample.van_trees).all()
    for array in (sample.error, sample.scalars["nees"], sample.number):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


# Memory --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_memory_holds_some_numbers_per_trial_and_no_matrix_per_estimator(tmp_path):
    """60,000 trials of 30 parameters: a matrix is 14 MB. What is over three further estimators adds 25 bytes a trial
    for each, of which comparisons are made, and as much on the way."""
    trials, n = 60_000, 30
    peaks = []
    for count in (1, 4):
        synthetic = Synthetic(tmp_path / str(count))
        scenario = synthetic.scenario(names=tuple(f"p{i}" for i in range(n)))
        for j in range(count):
            error = RNG(j).standard_normal((trials, n))
            synthetic.add(scenario, f"e{j}", error, block=trials // 2, estimator=Pretender(j))
        synthetic.record(trials)
        tracemalloc.start()
        analyse([tmp_path / str(count)])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 3 * trials * (25 + 25)
