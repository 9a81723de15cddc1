"""Tests between estimators give the values of their textbooks, and no difference where there is
none."""

import itertools
from collections import Counter

import numpy as np
import pytest
from scipy import stats
from shared.oracles import agreed, assert_agrees
from shared.synthetic_store import Pretender

from ipe_bench.report.tables.reports import all_tables
from ipe_bench.statistics import analyse
from ipe_bench.statistics.comparisons import (
    Outcomes,
    compare_pairs,
    corrected,
    differences,
    holm,
    may_be_best,
    mcnemar,
)
from ipe_bench.statistics.sample import distances_to_limit, iterations_to_limit


def outcomes(distance, success=True):
    distance = np.asarray(distance, dtype=float)
    return Outcomes(distance, np.broadcast_to(success, distance.shape) == 1)


def test_two_failures_are_a_tie_and_one_is_a_loss():
    d = differences(
        np.array([np.inf, np.inf, 1.0, np.nan]), np.array([np.inf, 2.0, np.inf, np.inf])
    )
    assert list(np.sign(d)) == [0, 1, -1, 0]


def p_of(d):
    """The p of error of a pair whose errors differ by d."""
    d = np.asarray(d, dtype=float)
    return compare_pairs({"a": outcomes(np.maximum(d, 0)), "b": outcomes(np.maximum(-d, 0))})[0][
        "p_error"
    ]


@pytest.mark.oracle("closed form: 2 of 32 assignments of signs", "p of the signed-rank test", 1e-9)
def test_signed_rank_of_five_positive_differences_is_one_sixteenth():
    # All five ranks on one side: 2 of 2^5 sign patterns.
    assert_agrees(p_of([1.0, 2.0, 3.0, 4.0, 5.0]), 2 / 32, rtol=1e-9)
    assert p_of([1.0, 2.0, 3.0, 4.0, np.inf, 0.0, 0.0]) == pytest.approx(2 / 32)
    assert p_of(np.zeros(10)) == 1.0


@pytest.mark.oracle(
    "closed form: all 512 assignments of signs", "p of the signed-rank test with ties", 1e-12
)
def test_signed_rank_counts_every_choice_of_signs_where_ranks_are_tied():
    d = np.array([1.0, 1.0, -1.0, 2.0, 2.0, 3.0, -0.5, np.inf, np.inf])
    ranks = stats.rankdata(np.abs(d))
    sums = [ranks @ (np.array(signs) > 0) for signs in itertools.product([-1, 1], repeat=len(d))]
    seen = ranks @ (d > 0)
    tail = min(np.mean(np.array(sums) <= seen), np.mean(np.array(sums) >= seen))
    assert_agrees(p_of(d), 2 * tail, rtol=1e-12)


def test_signed_rank_of_many_tied_ranks_counts_every_choice_of_signs():
    """Twenty differences of few sizes, where the normal law is 0.02 off."""
    d = np.round(2 * (np.random.default_rng(0).standard_normal(24) + 0.25))
    d = d[d != 0][:20]
    ranks = stats.rankdata(np.abs(d))
    ways = Counter({0: 1})
    for rank in ranks:
        ways = Counter({s: ways[s] + ways[s - rank] for s in {*ways, *(t + rank for t in ways)}})
    seen = min(ranks @ (d > 0), ranks @ (d < 0))
    exact = 2 * sum(number for total, number in ways.items() if total <= seen) / 2 ** len(d)
    assert p_of(d) == pytest.approx(exact, rel=1e-12)
    assert abs(exact - stats.wilcoxon(d, method="asymptotic").pvalue) > 0.015
    tieless = 1000 * np.random.default_rng(3).standard_normal(50) + 200
    assert p_of(tieless) == pytest.approx(stats.wilcoxon(tieless, method="exact").pvalue, rel=1e-9)


@pytest.mark.oracle("library: SciPy's binomtest", "p of McNemar's exact test", 1e-12)
@pytest.mark.parametrize("pair", [(1, 0), (4, 9), (9, 4), (6, 6), (40, 11)])
def test_mcnemar_is_the_binomial_test_of_scipy(pair):
    assert_agrees(mcnemar(*pair), stats.binomtest(pair[0], sum(pair), 0.5).pvalue, rtol=1e-12)
    assert mcnemar(0, 0) == 1.0


@pytest.mark.oracle("closed form: Holm's correction by hand", "four corrected p", 1e-12)
def test_holm_reproduces_a_worked_example():
    # p = 0.01, 0.04, 0.03, 0.005: sorted times 4, 3, 2, 1, made monotone.
    assert_agrees(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02], rtol=1e-12)
    assert holm([0.9, 0.8]).max() == 1.0
    assert len(holm([])) == 0


def test_equal_estimators_are_told_apart_in_at_most_one_of_twenty_repeats():
    rng = np.random.default_rng(1)
    false = 0
    for _ in range(200):
        d = rng.normal(5, 1, size=(3, 60))
        pairs = corrected(compare_pairs({str(i): outcomes(row) for i, row in enumerate(d)}))
        false += any(p["p_error"] < 0.05 for p in pairs)
    # Family-wise error 5 %, four standard deviations above it.
    assert false / 200 <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 200)


def test_the_best_are_left_out_no_oftener_than_stated():
    """600 boards of six estimators, of which two are truly best: how often a given one of them is
    left out."""
    rng, left_out = np.random.default_rng(5), 0
    share = np.array([0.9, 0.9, 0.88, 0.85, 0.7, 0.2])
    for _ in range(600):
        hard = rng.random((80, 1))
        # Trials that are hard for one are hard for all, as on the same readings.
        success = np.where(rng.random((80, 1)) < 0.5, hard, rng.random((80, 6))) < share
        best = may_be_best(success)
        left_out += not best[0]
        assert not best[5]
    assert left_out / 600 <= 0.05


@pytest.mark.oracle("library: SciPy's binomtest", "estimators marked wrongly, counted", 0)
def test_who_may_be_the_best_is_mcnemar_s_exact_test_against_every_rival():
    rng = np.random.default_rng(7)
    success = rng.random((60, 4)) < [0.9, 0.75, 0.6, 0.9]
    expected = []
    for i in range(4):
        p = []
        for j in set(range(4)) - {i}:
            alone, other = (
                (success[:, i] & ~success[:, j]).sum(),
                (success[:, j] & ~success[:, i]).sum(),
            )
            p.append(
                stats.binomtest(int(alone), int(alone + other), 0.5, alternative="less").pvalue
            )
        expected.append(min(p) > 0.05 / 3)
    agreed(np.sum(may_be_best(success) != expected), 0)
    assert len(set(expected)) == 2
    # Five wins without a loss have a p of 1/32, which is below 5 %, but not below a third of that.
    success = np.arange(30)[:, None] < [20, 25, 20, 20]
    assert may_be_best(success).all()
    assert may_be_best(success[:, :2]).tolist() == [False, True]
    assert may_be_best(np.ones((30, 3), dtype=bool)).all()
    assert may_be_best(np.zeros((30, 1), dtype=bool)).all()


def test_many_small_losses_do_not_outweigh_in_number_what_they_lose_in_rank():
    """A wins 60 of 100 trials by little and loses 40 by much: by ranks B is closer, whoever wins
    more often."""
    d = np.concatenate([np.full(60, -0.01), np.full(40, 1.0)]) * (1 + np.arange(100) / 1e4)
    pair = compare_pairs({"A": outcomes(5 + d), "B": outcomes(np.full(100, 5.0))})[0]
    assert pair["wins"] > pair["losses"]
    assert pair["favours"] == "B"


def test_iterations_to_the_limit_of_a_halving_sequence():
    history = np.array([[2.0**-k] for k in range(12)] + [[0.0]])
    distances = distances_to_limit(history, np.array([1.0]))
    # 2^-5 = 0.031 is the first within 0.05.
    assert iterations_to_limit(distances) == 5
    assert iterations_to_limit(np.array([0.01, 0.0])) == 0
    assert iterations_to_limit(np.array([0.01, 1.0, 0.0])) == 2


@pytest.mark.slow
def test_known_differences_are_found_in_a_store(synthetic):
    rng = np.random.default_rng(4)
    for scale in (1.0, 2.0):
        for seed in range(5):
            scenario = synthetic.scenario(error_scale=scale, seed=seed)
            base = 0.1 * rng.normal(size=(300, 3))
            synthetic.add(scenario, "good", base, simulations=3.0)
            synthetic.add(scenario, "same", base * (1 + 1e-9), simulations=9.0)
            synthetic.add(
                scenario, "bad", (3.0 if seed else 0.5) * base, simulations=1.0, jacobians=1.0
            )
    synthetic.add(
        synthetic.scenario(error_scale=1.0, seed=5), "good", np.zeros((300, 3))
    )  # a seed of one alone
    analysis = analyse([synthetic.directory])
    pairs = analysis.pairs.set_index(["first", "second"])
    assert (pairs.loc[("good", "same"), "ties"] == 1500).all()
    others = pairs[~pairs.index.isin([("good", "same")])]
    assert (others["p_error"] < 1e-6).all()
    best = analysis.summary.set_index("estimator")["may_be_best"]
    assert best["good"].all()
    assert best["same"].all()
    assert not best["bad"].any()
    # A Jacobian counts as three simulations here.
    assert set(analysis.scores[analysis.scores["estimator"] == "bad"]["cost_median"]) == {4.0}


def test_the_error_that_is_compared_is_a_distance_and_not_its_square(synthetic):
    """Every error 3 bounds in each of 3 parameters: the distance is 3 sqrt(3), which the gate does
    not cap."""
    synthetic.add(synthetic.scenario(), "one", np.full((30, 3), 0.3))
    synthetic.add(synthetic.scenario(), "two", np.full((30, 3), 0.1), start=10)
    analysis = analyse([synthetic.directory])
    scores = analysis.scores.set_index("estimator")
    assert scores.loc["one", "capped_error"] == pytest.approx(3 * np.sqrt(3))
    assert scores.loc["two", "capped_error"] == pytest.approx(np.sqrt(3))
    assert analysis.pairs.loc[0, "median_difference"] == pytest.approx(2 * np.sqrt(3))
    assert analysis.pairs.loc[0, "trials"] == 20  # those that both have


def test_closer_is_said_of_errors_and_bold_of_success(synthetic):
    rng = np.random.default_rng(8)
    d = 0.1 * rng.normal(size=(400, 3))
    failed = (np.arange(400) < 20)[:, None]
    synthetic.add(synthetic.scenario(), "A", 1.02 * d)
    synthetic.add(synthetic.scenario(), "B", np.where(failed, 1e6, d))
    analysis = analyse([synthetic.directory])
    assert analysis.pairs.loc[0, "closer"] == "B"
    tables = {t.name: t for t in all_tables(analysis)}
    finding = tables["comparisons"].columns[-1].cells[0].text
    bold = {cells[1].text for cells in tables["overview"].rows if any(cell.best for cell in cells)}
    assert (finding, bold) == ("B is closer", {"A"})


def test_success_of_all_estimators_is_by_the_same_gate(synthetic):
    """Users of a prior have no easier or harder gate than the others."""
    easy, hard = (synthetic.scenario(error_scale=s) for s in (1.0, 2.0))
    e = 0.1 * np.random.default_rng(9).normal(size=(50, 3))
    bayes = Pretender(knows_prior=True)
    synthetic.add(easy, "both", e)
    synthetic.add(hard, "both", np.full((50, 3), 9.0))
    synthetic.add(easy, "map", e, estimator=bayes, success=False)
    synthetic.add(hard, "map", e, estimator=bayes, success=False)
    analysis = analyse([synthetic.directory])
    pairs = analysis.pairs.set_index(["first", "second", "error_scale"])
    assert pairs.loc[("both", "map", 1.0), "only_first"] == 0
    assert pairs.loc[("both", "map", 2.0), "only_second"] == 50


def test_p_in_a_report_is_corrected_over_the_whole_sweep(synthetic):
    """Ten scenarios of two equal estimators, one with a difference that is significant by itself
    and not among ten."""
    rng = np.random.default_rng(11)
    raw = []
    for i in range(10):
        e, f = (0.1 * rng.normal(size=(60, 3)) for _ in range(2))
        scenario = synthetic.scenario(error_scale=1.0 + i)
        synthetic.add(scenario, "one", e)
        synthetic.add(scenario, "two", f)
        d = differences(*(np.sqrt(((x / 0.1) ** 2).sum(axis=1)) for x in (e, f)))
        raw.append(p_of(d))
    assert 0.005 < min(raw) < 0.05
    analysis = analyse([synthetic.directory])
    np.testing.assert_allclose(analysis.pairs["p_error"], holm(raw), rtol=1e-9)
    assert analysis.summary["may_be_best"].all()
    assert (analysis.pairs["closer"] == "").all()
