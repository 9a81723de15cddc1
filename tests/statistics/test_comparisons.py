"""Tests between estimators give the values of their textbooks, and no difference where there is none."""

import numpy as np
import pytest
from scipy import stats

from ipe_bench.statistics import analyse
from ipe_bench.statistics.comparisons import (
    TIE,
    Outcomes,
    compare_pairs,
    differences,
    holm,
    leaders,
    mcnemar,
    rank_over_scenarios,
    signed_rank,
    tied_ranks,
)
from ipe_bench.statistics.histories import distances_to_limit, iterations_to_limit
from ipe_bench.statistics.profiles import BUDGETS, RATIOS, Profiles


def outcomes(distance, success=None, cost=None, ids=None):
    distance = np.asarray(distance, dtype=float)
    n = len(distance)
    return Outcomes(
        np.arange(n) if ids is None else np.asarray(ids),
        distance,
        np.ones(n, dtype=bool) if success is None else np.asarray(success, dtype=bool),
        np.ones(n) if cost is None else np.asarray(cost, dtype=float),
    )


def test_round_off_is_a_tie_and_never_significant():
    rng = np.random.default_rng(0)
    d = rng.chisquare(11, 1000) ** 0.5
    pair = compare_pairs({"one": outcomes(d), "two": outcomes(d + rng.uniform(0, 0.99 * TIE, 1000))})[0]
    assert (pair.wins, pair.ties, pair.losses) == (0, 1000, 0)
    assert pair.p_error == 1.0
    assert pair.p_success == 1.0


def test_two_failures_are_a_tie_and_one_is_a_loss():
    d = differences(np.array([np.inf, np.inf, 1.0, np.nan]), np.array([np.inf, 2.0, np.inf, np.inf]))
    assert list(np.sign(d)) == [0, 1, -1, 0]


def test_signed_rank_of_five_positive_differences_is_one_sixteenth():
    # All five ranks on one side: 2 of 2^5 sign patterns.
    assert signed_rank(np.array([1.0, 2.0, 3.0, 4.0, 5.0])) == pytest.approx(2 / 32)
    assert signed_rank(np.array([1.0, 2.0, 3.0, 4.0, np.inf, 0.0, 0.0])) == pytest.approx(2 / 32)
    assert signed_rank(np.zeros(10)) == 1.0


def test_mcnemar_is_the_sign_test_of_discordant_trials():
    assert mcnemar(5, 0) == pytest.approx(2 / 32)
    assert mcnemar(3, 3) == 1.0
    assert mcnemar(0, 0) == 1.0
    assert mcnemar(10, 2) == pytest.approx(2 * stats.binom.cdf(2, 12, 0.5))


def test_holm_reproduces_a_worked_example():
    # p = 0.01, 0.04, 0.03, 0.005: sorted times 4, 3, 2, 1, made monotone.
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]).max() == 1.0
    assert len(holm([])) == 0


def test_equal_estimators_are_told_apart_in_at_most_one_of_twenty_repeats():
    rng = np.random.default_rng(1)
    false = 0
    for _ in range(200):
        d = rng.normal(5, 1, size=(3, 60))
        pairs = compare_pairs({str(i): outcomes(row) for i, row in enumerate(d)})
        false += any(p.p_error < 0.05 for p in pairs)
    # Family-wise error 5 %, four standard deviations above it.
    assert false / 200 <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 200)


def test_pairs_are_compared_on_the_trials_that_both_have():
    a = outcomes([1.0, 2.0, 3.0], ids=[0, 1, 2])
    b = outcomes([9.0, 2.0, 1.0], ids=[1, 2, 3])
    pair = compare_pairs({"a": a, "b": b})[0]
    assert (pair.trials, pair.wins, pair.losses) == (2, 1, 1)


def test_the_best_is_marked_only_where_somebody_is_worse():
    rng = np.random.default_rng(2)
    d = np.abs(rng.normal(3, 1, 300))
    same = {"one": outcomes(d), "two": outcomes(d)}
    assert leaders({"one": 3.0, "two": 3.0}, compare_pairs(same)) == set()
    three = same | {"three": outcomes(d + 0.5)}
    assert leaders({"one": 3.0, "two": 3.0, "three": 3.5}, compare_pairs(three)) == {"one", "two"}


def test_ranks_share_their_mean_where_scores_tie():
    np.testing.assert_allclose(tied_ranks(np.array([3.0, 1.0, 1.0 + TIE / 2, np.inf, np.inf])), [3, 1.5, 1.5, 4.5, 4.5])


def test_critical_difference_is_demsars():
    # Demsar 2006, sec. 3.2.2: four classifiers, 14 data sets, q = 2.569, CD = 1.25.
    rng = np.random.default_rng(3)
    scores = [dict(zip("abcd", rng.normal([0, 100, 200, 300], 100), strict=True)) for _ in range(14)]
    ranking = rank_over_scenarios(scores)
    assert ranking is not None
    assert ranking.critical_difference == pytest.approx(1.25, abs=0.005)
    table = np.array([[s[k] for k in "abcd"] for s in scores])
    assert ranking.friedman == pytest.approx(stats.friedmanchisquare(*table.T).pvalue)
    assert sum(ranking.mean_ranks.values()) == pytest.approx(10)


def test_ranking_needs_two_scenarios_and_two_estimators():
    assert rank_over_scenarios([{"a": 1.0, "b": 2.0}]) is None
    assert rank_over_scenarios([{"a": 1.0}, {"a": 2.0}]) is None
    alike = rank_over_scenarios([{"a": 1.0, "b": 1.0, "c": 1.0}] * 3)
    assert alike is not None
    assert alike.friedman == 1.0


def test_profiles_of_two_estimators_by_hand():
    # Costs: a 1, 4, fails, fails; b 2, 2, 8, fails.
    a = outcomes(np.ones(4), [1, 1, 0, 0], [1, 4, 1, 1])
    b = outcomes(np.ones(4), [1, 1, 1, 0], [2, 2, 8, 1])
    profiles = Profiles()
    profiles.add({"a": a, "b": b})

    def performance(label, ratio):
        return profiles.performance(label)[np.searchsorted(RATIOS, ratio, side="right") - 1]

    def data(label, budget):
        return profiles.data(label)[np.searchsorted(BUDGETS, budget, side="right") - 1]

    assert [performance("a", r) for r in (1, 2.5)] == [0.25, 0.5]
    assert [performance("b", r) for r in (1, 2.5)] == [0.5, 0.75]
    assert [data("a", c) for c in (1, 3, 4, 100)] == [0.25, 0.25, 0.5, 0.5]
    assert [data("b", c) for c in (1, 2, 8, 100)] == [0, 0.5, 0.75, 0.75]


def test_profiles_accumulate_over_scenarios():
    one = outcomes(np.ones(10), cost=np.full(10, 3.0))
    profiles = Profiles()
    profiles.add({"a": one})
    profiles.add({"a": outcomes(np.ones(10), np.zeros(10))})
    assert profiles.trials == {"a": 20}
    assert profiles.performance("a")[-1] == 0.5


def test_iterations_to_the_limit_of_a_halving_sequence():
    history = np.array([[2.0**-k] for k in range(12)] + [[0.0]])
    distances = distances_to_limit(history, np.array([1.0]))
    # 2^-5 = 0.031 is the first within 0.05.
    assert iterations_to_limit(distances) == 5
    assert iterations_to_limit(np.array([0.01, 0.0])) == 0
    assert iterations_to_limit(np.array([0.01, 1.0, 0.0])) == 2


def test_known_differences_are_found_in_a_store(synthetic):
    rng = np.random.default_rng(4)
    for scale in (1.0, 2.0, 3.0, 4.0):
        scenario = synthetic.scenario(error_scale=scale)
        base = 0.1 * rng.normal(size=(300, 3))
        synthetic.add(scenario, "good", base, simulations=3.0)
        synthetic.add(scenario, "same", base * (1 + 1e-9), simulations=9.0)
        synthetic.add(scenario, "bad", 1.3 * base, simulations=1.0, jacobians=1.0)
    analysis = analyse([synthetic.directory])
    pairs = analysis.pairs.set_index(["first", "second"])
    assert (pairs.loc[("good", "same"), "ties"] == 300).all()
    others = pairs[~pairs.index.isin([("good", "same")])]
    assert (others["p_error"] < 1e-6).all()
    leads = analysis.scores.set_index("estimator")["leads"]
    assert leads["good"].all()
    assert leads["same"].all()
    assert not leads["bad"].any()
    assert analysis.ranking is not None
    assert analysis.ranking.mean_ranks == {"good": 1.5, "same": 1.5, "bad": 3.0}
    # A Jacobian counts as three simulations here.
    assert set(analysis.scores[analysis.scores["estimator"] == "bad"]["cost_median"]) == {4.0}
    # Efficient errors are uncorrelated here, up to 1 / sqrt(300).
    for _, rows in analysis.correlations.groupby(["scenario", "estimator"]):
        matrix = rows["value"].to_numpy().reshape(3, 3)
        np.testing.assert_allclose(matrix, np.eye(3), atol=0.25)
