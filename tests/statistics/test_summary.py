"""On trials made up with known bias, variance and success, the summary says what theory says."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import beta, chi2
from shared.oracles import assert_agrees
from shared.synthetic_store import Filter, Pretender, Repeated, Synthetic, forge

from ipe_bench.statistics import analyse, summarize
from ipe_bench.statistics.intervals import clopper_pearson
from ipe_bench.statistics.registry import summary_columns


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
    assert b["bias_solved"] == pytest.approx(0.5)
    assert b["std_solved"] == pytest.approx(np.sqrt(n))
    assert b["rmse_solved"] == pytest.approx(np.sqrt(1.0 + 0.25))
    assert b["linear_bound"] == pytest.approx(1.0)
    assert b["crlb"] == pytest.approx(1.0)
    assert b["rmse_solved_over_linear_bound"] == pytest.approx(np.sqrt(1.25))
    assert b["efficiency_solved"] == pytest.approx(1 / np.sqrt(1.25))
    assert b["nees_solved"] == pytest.approx(1.25)
    assert b["rmse_solved_low"] < b["rmse_solved"]
    total = row(frame, "one")
    assert total["rmse_solved"] == pytest.approx(np.sqrt((1 + 1.25 + 1) / 3))
    assert total["bias_solved"] == pytest.approx(np.sqrt(0.25 / 3))
    assert total["nees_solved"] == pytest.approx((1 + 1.25 + 1) / 3)
    assert total["linear_bound"] == 1.0
    assert set(summary_columns()) <= set(frame.columns)


def test_shares_are_of_all_trials_and_moments_of_solved_ones(synthetic):
    scenario = synthetic.scenario()
    e = errors(400, bias=(0, 0, 0))
    solved = np.arange(400) < 300
    e[~solved] = 1e6
    e[390:] = np.nan
    status = np.where(np.arange(400) < 350, "converged", "diverged").astype(object)
    synthetic.add(
        scenario, "one", e, solved=solved, status=status, nees=np.where(solved, 3.0, np.nan)
    )
    total = row(summarize([synthetic.directory]), "one")
    assert total["trials"] == 400
    assert total["converged"] == 350 / 400
    assert total["solved"] == 300 / 400
    assert total["false_root"] == 50 / 400
    assert total["success"] == 300 / 400
    assert (total["success_low"], total["success_high"]) == clopper_pearson(300, 400)
    assert total["rmse_solved"] == pytest.approx(np.sqrt(np.mean((e[solved] / 0.1) ** 2)))
    assert total["nees_solved"] == pytest.approx(1.0)
    assert total["coverage95"] == 300 / 400
    assert total["q95_abs_error"] == pytest.approx(1e7)
    a = row(summarize([synthetic.directory]), "one", "a")
    worst = np.sort(np.where(np.isfinite(e[:, 0]), np.abs(e[:, 0]), np.inf))
    assert a["median_abs_error"] == pytest.approx(np.median(worst))


@pytest.mark.oracle(
    "closed form: chi-square of three degrees",
    "coverage of half the deviation, of 4000 trials",
    0.03,
)
def test_coverage_and_nees_of_an_estimator_that_boasts(synthetic):
    e = np.random.default_rng(5).normal(size=(4000, 3)) * 0.1
    synthetic.add(synthetic.scenario(), "honest", e)
    synthetic.add(synthetic.scenario(), "boaster", e, deviation=np.full(3, 0.05))
    frame = summarize([synthetic.directory])
    honest, boaster = row(frame, "honest"), row(frame, "boaster")
    assert (
        honest["nees_solved_low_if_honest"]
        < honest["nees_solved"]
        < honest["nees_solved_high_if_honest"]
    )
    assert honest["coverage95"] == pytest.approx(0.95, abs=0.015)
    assert boaster["nees_solved"] == pytest.approx(4 * honest["nees_solved"])
    # P(chi-square_3 < chi2_95 / 4)
    assert_agrees(boaster["coverage95"], 0.418, atol=0.03)
    assert_agrees(row(frame, "boaster", "a")["coverage95"], 0.673, atol=0.03)


def test_an_estimator_without_covariance_has_no_nees_and_no_coverage(synthetic):
    e = errors(50)
    synthetic.add(synthetic.scenario(), "mute", e, deviation=np.full(3, np.nan), nees=np.nan)
    frame = summarize([synthetic.directory])
    assert (
        frame[
            ["nees_solved", "nees_solved_low_if_honest", "nees_solved_high_if_honest", "coverage95"]
        ]
        .isna()
        .all(axis=None)
    )


def test_estimators_with_a_prior_are_held_against_the_bayesian_bound(synthetic):
    e = errors(300, bias=(0, 0, 0))
    synthetic.add(synthetic.scenario(), "plain", e)
    synthetic.add(synthetic.scenario(), "bayes", e, estimator=Pretender(knows_prior=True))
    # Half the deviation where the prior adds information: rewritten in the truth's file.
    rewrite_truth(synthetic, "bayes", 0.05)
    frame = summarize([synthetic.directory])
    assert row(frame, "plain")["efficiency_solved"] == pytest.approx(1.0)
    assert row(frame, "bayes")["efficiency_solved"] == pytest.approx(0.5)
    assert row(frame, "bayes")["bayes_bound"] == pytest.approx(0.5)


def test_one_label_for_two_configs_becomes_two_rows_with_the_option_in_the_label(synthetic):
    scenario = synthetic.scenario()
    for option in (1, 2):
        synthetic.add(scenario, "one", errors(50) * option, estimator=Pretender(option=option))
    synthetic.add(scenario, "two", errors(50))
    frame = summarize([synthetic.directory])
    assert set(frame["estimator"]) == {"one (option=1)", "one (option=2)", "two"}
    assert row(frame, "one (option=2)")["estimator.option"] == 2


@pytest.mark.slow
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
    pd.testing.assert_frame_equal(
        once, summarize([left.directory, right.directory]), check_exact=True
    )
    pd.testing.assert_frame_equal(
        once, summarize([right.directory, left.directory]), check_exact=True
    )
    # Overlapping pieces count each trial once.
    pd.testing.assert_frame_equal(
        once, summarize([whole.directory, right.directory]), check_exact=True
    )


def rewrite_truth(synthetic, kind: str, value: float) -> None:
    """Puts another number in place of a bound in the truth's files."""

    def change(rows, footer) -> None:
        rows |= {
            name: np.full(len(rows[name]), value) for name in rows if name.startswith(f"{kind}_")
        }

    for path in (synthetic.directory / "trials").glob("*.parquet"):
        forge(path, change)


def test_efficiency_is_against_the_bound_that_applies_and_not_the_linear_one(synthetic):
    """Bound at the truth 0.08, linear bound 0.1, errors of exactly 0.1: in every row, with its
    interval."""
    synthetic.add(synthetic.scenario(), "one", errors(300, bias=(0, 0, 0)))
    rewrite_truth(synthetic, "crlb", 0.08)
    frame = summarize([synthetic.directory])
    np.testing.assert_allclose(frame["efficiency_solved"], 0.8, rtol=1e-9)
    np.testing.assert_allclose(frame["efficiency_all"], 0.8, rtol=1e-9)
    np.testing.assert_allclose(frame["rmse_solved_over_linear_bound"], 1.0, rtol=1e-9)
    assert (frame["efficiency_solved_high"] > 0.8).all()
    bound = np.where(frame["parameter"] == "all", 0.8, frame["crlb"])
    np.testing.assert_allclose(
        frame["efficiency_solved_high"], bound / frame["rmse_solved_low"], rtol=1e-9
    )


@pytest.mark.parametrize(("solved", "known"), [(19, False), (20, True)])
def test_few_solved_trials_have_no_interval(synthetic, solved, known):
    synthetic.add(synthetic.scenario(), "one", errors(100), solved=np.arange(100) < solved)
    frame = summarize([synthetic.directory])
    assert (frame["solved_trials"] == solved).all()
    assert (frame["rmse_solved_low"].notna() == known).all()
    assert frame["rmse_solved"].notna().all()


def test_errors_of_all_trials_let_none_off(synthetic):
    e = errors(100)
    e[0] = 1e3
    synthetic.add(synthetic.scenario(), "far", e, solved=np.arange(100) > 0)
    e = e.copy()
    e[0] = np.nan
    status = np.where(np.arange(100) > 0, "converged", "nonfinite")
    synthetic.add(synthetic.scenario(), "gone", e, solved=np.arange(100) > 0, status=status)
    frame = summarize([synthetic.directory])
    far, gone = row(frame, "far"), row(frame, "gone")
    assert far["rmse_solved"] == gone["rmse_solved"]
    assert far["rmse_all"] == pytest.approx(1e4 / np.sqrt(100), rel=1e-3)
    assert gone["rmse_all"] == np.inf
    assert gone["efficiency_all"] == 0.0


def test_one_runaway_does_not_decide(synthetic):
    e = errors(200, bias=(0, 0, 0))
    e[0] = 1e9
    synthetic.add(synthetic.scenario(), "one", e)
    total = row(summarize([synthetic.directory]), "one")
    assert total["efficiency_all"] < 1e-6
    squares = np.minimum((e**2).sum(axis=1) / 0.1**2 / 3, 25.0)
    assert total["efficiency_capped"] == pytest.approx(1 / np.sqrt(squares.mean()))
    assert 0.9 < total["efficiency_capped"] < 0.97
    low, high = total["efficiency_capped_low"], total["efficiency_capped_high"]
    # As many trials at the cap as the upper limit of 1 in 200 allows beyond the one.
    most = squares.mean() + (beta.ppf(0.95, 2, 199) - 1 / 200) * 24
    assert 0.8 / np.sqrt(most) < low < 1 / np.sqrt(most)
    assert total["efficiency_capped"] < high < 1.1
    assert total["error_median"] == pytest.approx(
        np.median(np.sqrt((e**2).sum(axis=1) / 0.1**2 / 3))
    )
    assert total["error_q95"] == pytest.approx(
        np.quantile(np.sqrt((e**2).sum(axis=1) / 0.1**2 / 3), 0.95)
    )


def test_everybody_is_judged_by_the_same_trials(synthetic):
    """A filter, an estimator that seeks a root and fails in half of the trials, one that returns
    nothing at all."""
    e = errors(100, bias=(0, 0, 0))
    half = np.arange(100) < 50
    ended = np.where(half, "converged", "nonfinite")
    synthetic.add(synthetic.scenario(), "filter", 2 * e, estimator=Filter())
    lost = {"nees": np.where(half, 3.0, np.nan), "status": ended, "solved": half}
    synthetic.add(synthetic.scenario(), "half", np.where(half[:, None], e, np.nan), **lost)
    synthetic.add(synthetic.scenario(), "nothing", e * np.nan, solved=False, status="nonfinite")
    frame = summarize([synthetic.directory])
    filtered, half, nothing = (row(frame, label) for label in ("filter", "half", "nothing"))
    assert filtered["efficiency_capped"] == pytest.approx(0.5)
    assert filtered["nees_median"] == pytest.approx(
        np.median((2 * e / 0.1) ** 2 @ np.ones(3)) / chi2.median(3)
    )
    assert half["efficiency_capped"] == pytest.approx(1 / np.sqrt((25 + 1) / 2), rel=0.1)
    assert (
        half["efficiency_capped_low"] < half["efficiency_capped"] < half["efficiency_capped_high"]
    )
    assert half["error_q95"] == np.inf
    assert nothing["efficiency_capped"] == pytest.approx(0.2)
    assert nothing["error_median"] == nothing["nees_median"] == np.inf


def test_the_median_of_honest_nees_lies_within_its_limits_in_95_per_cent_of_runs(synthetic):
    synthetic.add(synthetic.scenario(), "one", errors(40))
    total = row(summarize([synthetic.directory]), "one")
    medians = np.median(chi2.rvs(3, size=(4000, 40), random_state=1), axis=1) / chi2.median(3)
    inside = np.mean(
        (total["nees_median_low_if_honest"] <= medians)
        & (medians <= total["nees_median_high_if_honest"])
    )
    # The median of an even number is the mean of two values, which scatters a little less than one.
    assert 0.94 < inside < 0.975


def test_a_failure_is_known_or_silent(synthetic):
    """Four wrong of ten: one did not converge, one does not fit, one is flagged as ambiguous, and
    one looks right."""
    right = np.arange(10) >= 4
    e = np.where(right[:, None], 0.0, 5.0) + np.zeros(3)
    status = np.array(["max_iterations"] + ["converged"] * 9, dtype=object)
    fit = np.array([0.5, 1e-5] + [0.5] * 8)
    ambiguous = np.array([0.0, 0.0, 1.0] + [0.0] * 7)
    synthetic.add(
        synthetic.scenario(),
        "one",
        e,
        status=status,
        solved=right,
        fit_p=fit,
        extra_ambiguous=ambiguous,
    )
    synthetic.add(synthetic.scenario(), "untested", e, status=status, solved=right)
    frame = summarize([synthetic.directory])
    assert tuple(row(frame, "one")[["success", "failed_known", "failed_silent"]]) == (0.6, 0.3, 0.1)
    assert tuple(row(frame, "untested")[["failed_known", "failed_silent"]]) == (0.1, 0.3)


def test_a_jacobian_counts_what_the_model_says_it_costs(synthetic):
    @dataclass(frozen=True)
    class Dear(Repeated):
        jacobian_cost = 25.0

    e = errors(30)
    synthetic.add(synthetic.scenario(), "cheap", e, simulations=2.0, jacobians=1.0)
    dear = replace(synthetic.scenario(), measurement=Dear())
    synthetic.add(dear, "dear", e, simulations=2.0, jacobians=1.0)
    frame = summarize([synthetic.directory])
    assert row(frame, "cheap")["simulations_median"] == 5.0
    assert row(frame, "dear")["simulations_median"] == 27.0


def test_epochs_of_a_filter_are_not_iterations(synthetic):
    scenario = synthetic.scenario()
    path = 0.1 * 0.5 ** np.arange(6.0)
    history = {"trial": np.zeros(6, dtype=int), "iteration": np.arange(6)} | {
        f"x_{n}": path for n in "abc"
    }
    synthetic.add(scenario, "ekf", errors(40), iterations=30, estimator=Filter(), history=history)
    synthetic.add(scenario, "newton", errors(40), iterations=3, history=history)
    analysis = analyse([synthetic.directory])
    assert np.isnan(row(analysis.summary, "ekf")["iterations_median"])
    assert row(analysis.summary, "newton")["iterations_median"] == 3
    scores = analysis.scores.set_index("estimator")
    assert np.isnan(scores.loc["ekf", "order_median"])
    assert scores.loc["ekf", "histories"] == 0
    assert scores.loc["newton", "histories"] == 1
