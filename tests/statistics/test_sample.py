"""What is summed up of stored trials is what pandas makes of them, however they are cut into
files."""

import tracemalloc
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm
from shared.oracles import assert_agrees
from shared.synthetic_store import Pretender, Seeker, Synthetic

import ipe_bench as ib
from ipe_bench.runs.store import ResultKey
from ipe_bench.statistics import analyse, formulas, summarize
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.collect import collect
from ipe_bench.statistics.sample import samples

TRIALS = 3000
RNG = np.random.default_rng


def fill(folder: Path, blocks: tuple[int, int, int]) -> Synthetic:
    """Two estimators, a filter-like one and one that seeks a root, on two seeds; every 25th trial
    has no finite estimate, others are not solved, and the truth of some is not stored. Cut into
    blocks of three sizes."""
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
            more = {
                "status": status,
                "solved": solved,
                "deviation": deviation,
                "time_s": rng.random(TRIALS),
            }
            more["crlb_distance"] = ((error / bound) ** 2).sum(axis=1)
            more["nees"] = ((error / deviation) ** 2).sum(axis=1)
            more["success"] = np.nan_to_num(more["crlb_distance"], nan=1e9) < 16
            synthetic.add(scenario, label, error, block=blocks[j], estimator=estimator, **more)
        truth = ResultKey(scenario)
        for path in synthetic.store.trials.glob(f"{truth.key}-*"):
            path.unlink()
        drawn = rng.uniform(0.5, 1.5, (4, TRIALS, 3))
        names = [p.name for p in scenario.measurement.parameters]
        facts = {
            "trial": np.arange(TRIALS),
            "curvature_intrinsic": np.where(np.arange(TRIALS) < 5, 0.1, np.nan),
        }
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
    fill(folder, (TRIALS, 800, 1100))
    return folder


@pytest.fixture(scope="module")
def analysis(store) -> Analysis:
    return analyse([store])


@pytest.mark.oracle(
    "library: pandas",
    "bias, deviation, RMSE, bounds, NEES, coverage and quantiles of the summary",
    1e-11,
)
def test_every_sum_is_that_of_pandas_over_all_rows_at_once(store, analysis):
    """Each formula once more, over whole columns."""
    summary = analysis.summary.set_index(["estimator", "parameter"])
    rows = ib.load(store)
    sizes = {"a": 1.0, "b": 10.0, "c": 0.1}
    linear = 0.2 / 2
    for label in ("root", "plain"):
        mine = rows[rows["estimator"] == label]
        solved = mine[mine["solved"]]
        squares = mine[[f"error_{n}" for n in sizes]] ** 2
        together = squares.mean(axis=1, skipna=False) ** 0.5 / linear
        overall = summary.loc[label, "all"]
        limited = together.fillna(1e300).quantile([0.5, 0.95])
        assert [overall["median_abs_error"], overall["q95_abs_error"]] == pytest.approx(
            list(limited), rel=1e-12
        )
        for name, size in sizes.items():
            found, e = summary.loc[label, name], solved[f"error_{name}"]
            ratio = (mine[f"error_{name}"] / mine[f"deviation_{name}"]).abs()
            expected = {
                "bias_solved": size * e.mean(),
                "std_solved": size * e.std(),
                "rmse_solved": size * np.sqrt((e**2).mean()),
                "rmse_all": np.inf,
                "effective_trials": (e**2).sum() ** 2 / (e**4).sum(),
                "crlb": size * np.sqrt((solved[f"crlb_{name}"] ** 2).mean()),
                "bayes_bound": size * np.sqrt((solved[f"bayes_{name}"] ** 2).mean()),
                "reported": size * np.sqrt((solved[f"deviation_{name}"] ** 2).mean()),
                "nees_solved": (ratio[mine["solved"]] ** 2).mean(),
                "coverage95": (ratio <= norm.isf(0.025)).mean(),
                "median_abs_error": size * mine[f"error_{name}"].abs().fillna(1e300).quantile(0.5),
                "q95_abs_error": size * mine[f"error_{name}"].abs().fillna(1e300).quantile(0.95),
                "curvature_intrinsic": 0.1,
            }
            if label == "root":
                compensation = ((e - solved[f"linear_error_{name}"]) ** 2).mean()
                expected["eq_14"] = size * np.sqrt(linear**2 + compensation)
            for column, value in expected.items():
                assert_agrees(found[column], value, rtol=1e-11)
            assert found["rmse_solved_low"] < found["rmse_solved"]


def test_no_bit_depends_on_how_rows_are_cut_into_files(analysis, tmp_path):
    fill(tmp_path, (277, TRIALS, 734))
    pd.testing.assert_frame_equal(summarize([tmp_path]), analysis.summary, check_exact=True)


def test_a_truth_that_is_missing_is_not_a_number_beside_its_estimates(synthetic):
    """Of five blocks of the truth the second and the last are lost, and one estimator has fewer
    trials."""
    scenario, rng = synthetic.scenario(), RNG(3)
    synthetic.add(scenario, "long", 0.1 * rng.standard_normal((50, 3)), block=10)
    synthetic.add(
        scenario, "short", 0.1 * rng.standard_normal((15, 3)), start=8, estimator=Pretender(1)
    )
    for path in synthetic.store.trials.glob(f"{ResultKey(scenario).key}-*"):
        if path.name.split("-")[1] in ("10", "40", "8"):
            path.unlink()
    collection = collect([synthetic.directory])
    for sample in samples(collection, collection.groups):
        trial = sample.number % (1 << 40)
        known = ~((trial >= 10) & (trial < 20) | (trial >= 40))
        np.testing.assert_array_equal(
            np.isfinite(sample.of_truth("crlb")), np.repeat(known[:, None], 3, axis=1)
        )
        assert np.isnan(sample.of_truth("linear_error")).all()


def test_bounds_of_several_seeds_are_pooled_as_squares(tmp_path):
    """Van Trees's of two seeds, and the error of the mean of their squares."""
    scenarios = [
        ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0, seed=s)
        for s in (0, 1)
    ]
    rows = ib.run(scenarios, {"linear": ib.baselines.LinearLSE()}, 4, output=tmp_path)
    stored = ib.load(tmp_path)
    stored = stored[stored["trial"] == 0]
    for name, row in rows.set_index("parameter").drop(index="all").iterrows():
        bound, error = (
            stored[f"van_trees_{name}"].to_numpy(),
            stored[f"van_trees_error_{name}"].to_numpy(),
        )
        size = row["linear_bound"] / sample_bound(tmp_path, str(name))
        mean = np.sqrt(np.mean(bound**2))
        assert row["van_trees"] == pytest.approx(size * mean)
        reach = norm.isf(0.025) * np.sqrt(np.sum((2 * bound * error) ** 2)) / 2 / (2 * mean)
        assert row["van_trees_high"] == pytest.approx(size * (mean + reach))


def sample_bound(folder: Path, name: str) -> float:
    """The linear bound in multiples of the parameter's size."""
    footer = collect([folder]).groups[0].footer
    return footer["linear_bound"][[p["name"] for p in footer["parameters"]].index(name)]


@pytest.mark.parametrize(("shared", "degrees"), [(1.0, (1,)), (0.0, (2, 3))])
def test_all_parameters_have_as_many_degrees_as_their_errors_are_apart(synthetic, shared, degrees):
    rng = RNG(0)
    common, own = rng.standard_normal((500, 1)), rng.standard_normal((500, 3))
    synthetic.add(synthetic.scenario(), "one", 0.1 * (shared * common + (1 - shared) * own))
    collection = collect([synthetic.directory])
    found = formulas.degrees(next(samples(collection, collection.groups)))
    assert found[3] in degrees
    assert (np.delete(found, 3) == 1).all()


@pytest.mark.slow
def test_a_million_trials_would_fit_into_2_gib(tmp_path):
    """11 parameters and 50,000 trials, at 2 GiB for each million."""
    trials = 50_000
    synthetic = Synthetic(tmp_path)
    scenario = synthetic.scenario(names=tuple(f"p{i}" for i in range(11)))
    for j in range(3):
        error = 0.1 * RNG(j).standard_normal((trials, 11))
        synthetic.add(scenario, f"e{j}", error, block=trials // 4, estimator=Pretender(j))
    synthetic.record(trials)
    analyse([tmp_path])  # libraries that it imports are no memory of trials
    tracemalloc.start()
    analyse([tmp_path])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**31 * trials / 1e6
