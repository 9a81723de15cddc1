"""On trials made up with known bias, variance and success, the summary says what theory says."""

import numpy as np
import pandas as pd
import pytest
from synthetic_store import Pretender, Synthetic

from ipe_bench.statistics import summarize
from ipe_bench.statistics.consistency import clopper_pearson
from ipe_bench.statistics.summary import COLUMNS


def row(frame: pd.DataFrame, estimator: str, parameter: str = "all", **where) -> pd.Series:
    chosen = frame[(frame["estimator"] == estimator) & (frame["parameter"] == parameter)]
    for key, value in where.items():
        chosen = chosen[chosen[key] == value]
    assert len(chosen) == 1, chosen
    return chosen.iloc[0]


def errors(trials: int, seed: int = 0, bias=(0.0, 0.05, 0.0), factor: float = 1.0) -> np.ndarray:
    """Efficient errors about a bias, for the synthetic scenario's bound of 0.1."""
    e = np.random.default_rng(seed).normal(size=(trials, 3))
    # Exactly centred and scaled, so that sample moments are known without sampling error.
    e = (e - e.mean(axis=0)) / e.std(axis=0)
    return 0.1 * factor * e + np.asarray(bias)


def test_moments_are_those_of_the_errors_in_physical_units(synthetic):
    scenario = synthetic.scenario()
    synthetic.add(scenario, "one", errors(500), block=100)
    frame = summarize([synthetic.directory])
    assert list(frame["parameter"]) == ["a", "b", "c", "all"]
    assert list(frame["unit"])[:3] == ["m", "m", "m"]
    b = row(frame, "one", "b")  # its size is 10 m
    n = 500 / 499
    assert b["bias"] == pytest.approx(0.5)
    assert b["std"] == pytest.approx(np.sqrt(n))
    assert b["rmse"] == pytest.approx(np.sqrt(1.0 + 0.25))
    assert b["linear_bound"] == pytest.approx(1.0)
    assert b["crlb"] == pytest.approx(1.0)
    assert b["rmse_over_linear_bound"] == pytest.approx(np.sqrt(1.25))
    assert b["efficiency"] == pytest.approx(1 / np.sqrt(1.25))
    assert b["nees"] == pytest.approx(1.25)
    assert b["rmse_low"] < b["rmse"] < b["rmse_high"]
    total = row(frame, "one")
    assert total["rmse"] == pytest.approx(np.sqrt((1 + 1.25 + 1) / 3))
    assert total["bias"] == pytest.approx(np.sqrt(0.25 / 3))
    assert total["nees"] == pytest.approx((1 + 1.25 + 1) / 3)
    assert total["linear_bound"] == 1.0
    assert set(COLUMNS) <= set(frame.columns)


def test_shares_are_of_all_trials_and_moments_of_solved_ones(synthetic):
    scenario = synthetic.scenario()
    e = errors(400, bias=(0, 0, 0))
    solved = np.arange(400) < 300
    e[~solved] = 1e6
    e[390:] = np.nan
    status = np.where(np.arange(400) < 350, "converged", "diverged").astype(object)
    synthetic.add(scenario, "one", e, solved=solved, status=status, nees=np.where(solved, 3.0, np.nan))
    total = row(summarize([synthetic.directory]), "one")
    assert total["trials"] == 400
    assert total["converged"] == 350 / 400
    assert total["solved"] == 300 / 400
    assert total["false_root"] == 50 / 400
    assert total["success"] == 300 / 400
    assert (total["success_low"], total["success_high"]) == clopper_pearson(300, 400)
    assert total["rmse"] == pytest.approx(np.sqrt(np.mean((e[solved] / 0.1) ** 2)))
    assert total["nees"] == pytest.approx(1.0)
    assert total["coverage95"] == 300 / 400
    assert total["q95_abs_error"] == pytest.approx(1e7)
    a = row(summarize([synthetic.directory]), "one", "a")
    worst = np.sort(np.where(np.isfinite(e[:, 0]), np.abs(e[:, 0]), np.inf))
    assert a["median_abs_error"] == pytest.approx(np.median(worst))


def test_more_than_five_per_cent_without_a_number_make_the_95_per_cent_error_infinite(synthetic):
    e = errors(100)
    e[:6] = np.nan
    synthetic.add(synthetic.scenario(), "one", e, solved=np.arange(100) >= 6)
    frame = summarize([synthetic.directory])
    assert (frame["q95_abs_error"] == np.inf).all()
    assert np.isfinite(frame["median_abs_error"]).all()


def test_common_trials_are_those_that_every_rival_solved(synthetic):
    scenario = synthetic.scenario()
    e = errors(200)
    t = np.arange(200)
    synthetic.add(scenario, "one", e, solved=t < 150)
    synthetic.add(scenario, "two", 2 * e, solved=t >= 50)
    both = (t >= 50) & (t < 150)
    frame = summarize([synthetic.directory])
    expected = np.sqrt(np.mean((e[both] / 0.1) ** 2))
    assert row(frame, "one")["rmse_common"] == pytest.approx(expected)
    assert row(frame, "two")["rmse_common"] == pytest.approx(2 * expected)


def test_coverage_and_nees_of_an_estimator_that_boasts(synthetic):
    e = np.random.default_rng(5).normal(size=(4000, 3)) * 0.1
    synthetic.add(synthetic.scenario(), "honest", e)
    synthetic.add(synthetic.scenario(), "boaster", e, deviation=np.full(3, 0.05))
    frame = summarize([synthetic.directory])
    honest, boaster = row(frame, "honest"), row(frame, "boaster")
    assert honest["nees_low"] < honest["nees"] < honest["nees_high"]
    assert honest["coverage95"] == pytest.approx(0.95, abs=0.015)
    assert boaster["nees"] == pytest.approx(4 * honest["nees"])
    # P(chi-square_3 < chi2_95 / 4)
    assert boaster["coverage95"] == pytest.approx(0.418, abs=0.03)
    assert row(frame, "boaster", "a")["coverage95"] == pytest.approx(0.673, abs=0.03)


def test_an_estimator_without_covariance_has_no_nees_and_no_coverage(synthetic):
    e = errors(50)
    synthetic.add(synthetic.scenario(), "mute", e, deviation=np.full(3, np.nan), nees=np.nan)
    frame = summarize([synthetic.directory])
    assert frame[["nees", "nees_low", "nees_high", "coverage95"]].isna().all(axis=None)


def test_estimators_with_a_prior_are_held_against_the_bayesian_bound(synthetic):
    e = errors(300, bias=(0, 0, 0))
    synthetic.add(synthetic.scenario(), "plain", e)
    synthetic.add(synthetic.scenario(), "bayes", e, estimator=Pretender(knows_prior=True))
    # Half the deviation where the prior adds information: rewritten in the truth's file.
    for path in (synthetic.directory / "trials").glob("*.parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pq.read_table(path)
        for name in [n for n in table.column_names if n.startswith("bayes_")]:
            at = table.column_names.index(name)
            table = table.set_column(at, name, pa.array(np.full(table.num_rows, 0.05)))
        pq.write_table(table, path)
    frame = summarize([synthetic.directory])
    assert row(frame, "plain")["efficiency"] == pytest.approx(1.0)
    assert row(frame, "bayes")["efficiency"] == pytest.approx(0.5)
    assert row(frame, "bayes")["bayes_bound"] == pytest.approx(0.5)


def test_seeds_are_pooled_and_nothing_else_is(synthetic):
    for seed in (1, 2):
        for sigma in (0.2, 0.4):
            e = errors(100, seed=seed) * sigma / 0.2
            synthetic.add(synthetic.scenario(seed=seed, sigma=sigma), "one", e)
    frame = summarize([synthetic.directory])
    assert "noise.deviation" in frame.columns
    assert set(frame["noise.deviation"]) == {0.2, 0.4}
    assert (frame["trials"] == 200).all()
    assert len(frame) == 2 * 4


def test_one_label_for_two_configs_becomes_two_rows_with_the_option_in_the_label(synthetic):
    scenario = synthetic.scenario()
    for option in (1, 2):
        synthetic.add(scenario, "one", errors(50) * option, estimator=Pretender(option=option))
    synthetic.add(scenario, "two", errors(50))
    frame = summarize([synthetic.directory])
    assert set(frame["estimator"]) == {"one (option=1)", "one (option=2)", "two"}
    assert row(frame, "one (option=2)")["estimator.option"] == 2


def test_halves_in_two_directories_are_one_run(tmp_path):
    scenarios = [Synthetic.scenario(error_scale=s) for s in (1.0, 10.0)]
    e = {label: errors(600, seed=i) for i, label in enumerate(("one", "two"))}
    whole, left, right = (Synthetic(tmp_path / name) for name in ("whole", "left", "right"))
    for scenario in scenarios:
        for label, error in e.items():
            solved = np.random.default_rng(9).random(600) < 0.9
            whole.add(scenario, label, error, solved=solved, block=150)
            left.add(scenario, label, error[:300], solved=solved[:300], block=100)
            right.add(scenario, label, error[300:], solved=solved[300:], start=300)
    for store in (whole, left, right):
        store.record(600)
    once = summarize([whole.directory])
    pd.testing.assert_frame_equal(once, summarize([left.directory, right.directory]), check_exact=True)
    pd.testing.assert_frame_equal(once, summarize([right.directory, left.directory]), check_exact=True)
    # Overlapping pieces count each trial once.
    pd.testing.assert_frame_equal(once, summarize([whole.directory, right.directory]), check_exact=True)


def test_nothing_stored_is_an_empty_table_with_its_columns(tmp_path):
    frame = summarize([tmp_path])
    assert frame.empty
    assert "rmse_over_linear_bound" in frame.columns
