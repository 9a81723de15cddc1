"""Paired effects against exhaustive enumeration and maximised likelihoods; evidence that keeps its
promise."""

import itertools

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import beta, chi, norm
from shared.oracles import assert_agrees

from ipe_bench.questions.compare.effects import (
    fair_coin,
    mean_effect,
    no_lean,
    ratio_effect,
    success_effect,
)


def successes(both: int, only_first: int, only_second: int, neither: int):
    pairs = [(1, 1)] * both + [(1, 0)] * only_first + [(0, 1)] * only_second + [(0, 0)] * neither
    return np.array(pairs, dtype=bool).T


def test_the_p_of_a_ratio_is_the_share_of_all_signs():
    """All 4,096 assignments of signs to twelve differences, within 4 deviations of the 4,999 that
    are drawn."""
    rng = np.random.default_rng(0)
    a, b = rng.gamma(3, size=12), rng.gamma(4.5, size=12)
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=12)))
    exact = (np.abs(signs @ (b - a)) >= abs((b - a).sum()) - 1e-12).mean()
    assert 0.01 < exact < 0.5
    assert abs(ratio_effect(a, b).p - exact) < 4 * np.sqrt(exact / 4999)


def test_an_interval_of_a_ratio_holds_1_where_the_test_does_not_reject():
    rng = np.random.default_rng(1)
    verdicts = []
    for _ in range(60):
        a = rng.gamma(3, size=40)
        effect = ratio_effect(a, 0.5 * a + 0.58 * rng.gamma(3, size=40))
        verdicts.append(effect.p < 0.05)
        assert (effect.p < 0.05) != (effect.low <= 1 <= effect.high)
    assert 5 < sum(verdicts) < 55


@pytest.mark.slow
def test_an_interval_of_a_ratio_covers_it():
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(400):
        a = rng.gamma(3, size=80)
        effect = ratio_effect(a, 2 * (0.5 * a + 0.5 * rng.gamma(3, size=80)))
        held += effect.low <= 2 <= effect.high
    assert abs(held / 400 - 0.95) < 4 * np.sqrt(0.05 * 0.95 / 400)


def test_a_ratio_is_that_of_the_means_and_turns_with_the_order():
    a, b = np.array([1.0, 2.0, 3.0, 5.0] * 10), np.array([2.0, 2.5, 3.0, 6.0] * 10)
    forth, back = ratio_effect(a, b), ratio_effect(b, a)
    assert forth.change == pytest.approx(b.mean() / a.mean())
    assert back.low == pytest.approx(1 / forth.high)
    assert back.high == pytest.approx(1 / forth.low)
    assert ratio_effect(a, a).p == 1.0


def test_a_few_trials_that_differ_are_no_finding_however_far():
    """Three differences of one side have a p of 1/4 by signs; a normal approximation would call
    them sure."""
    a = np.ones(1000)
    b = a.copy()
    b[:3] = 7.0
    assert ratio_effect(a, b).p == pytest.approx(0.25, abs=0.03)
    assert ratio_effect(a, b).low <= 1.0


def test_sure_differences_have_a_p_beyond_the_number_of_signs():
    """Hoeffding's bound: 2 exp(-n / 2) for n equal differences."""
    assert ratio_effect(np.full(200, 3.0), np.full(200, 4.0)).p == pytest.approx(
        2 * np.exp(-100.0), abs=0
    )


@pytest.mark.parametrize("trials", [1, 2, 3, 5])
def test_so_few_trials_leave_the_interval_open(trials):
    """All signs of five differences are alike in a share of 2 / 2^5 > .05: no ratio is rejected."""
    a = np.arange(1.0, trials + 1)
    effect = ratio_effect(a, 2 * a)
    assert (effect.change, effect.low, effect.high) == (pytest.approx(2.0), 0.0, np.inf)
    assert effect.p == pytest.approx(2 / 2**trials, abs=0.03)


def rarely_worse(q: float, trials: int, studies: int) -> tuple[float, float]:
    """Coverage and median width of the ratio of mean errors, each at most 6, where the second is
    the first but for a share q of trials in which it is 6."""
    rng = np.random.default_rng(trials)
    true, held, widths = (1 - q) + q * 6 / chi(3).mean(), 0, []
    for _ in range(studies):
        a = np.minimum(chi(3).rvs(trials, random_state=rng), 6.0)
        effect = ratio_effect(a, np.where(rng.random(trials) < q, 6.0, a), largest=6.0)
        held += effect.low <= true <= effect.high
        widths.append(effect.high - effect.low)
    return held / studies, float(np.median(widths))


RARE = [(0.02, 20), (0.02, 50), (0.01, 100), (0.01, 200), (0.05, 100), (0.05, 200), (0.1, 200)]
STUDIES = [
    *((*case, 40) for case in RARE[:2]),
    *(pytest.param(*case, 40, marks=pytest.mark.slow) for case in RARE[2:4]),
] + [pytest.param(*case, 1000, marks=pytest.mark.campaign) for case in RARE]


@pytest.mark.parametrize(("q", "trials", "studies"), STUDIES)
def test_intervals_count_the_failures_that_may_be_unseen(q, trials, studies):
    """Random signs alone cover .35, .61, .65 and .75: where both agree in every trial seen, their
    interval is a point. Widths are finite: the rule of three, 3.7 / N failures of 6 on top of a
    mean of 1.6, to either side."""
    covered, width = rarely_worse(q, trials, studies)
    assert covered >= 0.93
    assert width < 2.2 * 2 * 3.7 / trials * 6 / 1.6 or q > 0.02


def test_an_interval_is_widened_only_where_nearly_all_trials_agree():
    """Where all trials differ it is that of random signs, 2 x 1.96 standard errors of the ratio
    wide."""
    rng = np.random.default_rng(0)
    a = rng.normal(5, 1, 200)
    b = a + rng.normal(0, 0.5, 200)
    effect = ratio_effect(a, b, largest=1e6)
    assert effect.high - effect.low == pytest.approx(2 * 1.96 * 0.5 / 5 / np.sqrt(200), rel=0.15)
    same = ratio_effect(a, a, largest=6.0)
    assert 1 - same.low == pytest.approx(same.high - 1)
    assert same.high - 1 == pytest.approx((1 - 0.025 ** (1 / 200)) * 6.0 / a.mean())
    # What the second may differ by is a part of the mean of the first, whichever is larger.
    for factor in (3.0, 1 / 3):
        ratio = ratio_effect(a, factor * a, largest=6.0)
        assert ratio.high - factor == pytest.approx((1 - 0.025 ** (1 / 200)) * 6.0 / a.mean())


def test_a_widened_interval_says_what_the_test_says():
    """Eight of 400 trials are larger: a p of 2 / 2^8, so that 1 is outside of the interval, however
    wide it is."""
    a = np.ones(400)
    b = a.copy()
    b[:8] = 1.5
    effect = ratio_effect(a, b, largest=6.0)
    assert effect.p < 0.05
    assert 1.0 <= effect.low < effect.change < 1 + 8 / 400 * 5 < effect.high


def test_a_mean_difference_has_the_normal_interval_and_the_p_of_all_signs():
    rng = np.random.default_rng(4)
    first, second = rng.standard_normal(12), 0.4 + rng.standard_normal(12)
    effect, d = mean_effect(first, second, 0.05, 8.0), second - first
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=12)))
    exact = (np.abs(signs @ d) >= abs(d.sum()) - 1e-12).mean()
    assert 0.01 < exact < 0.5
    assert abs(effect.p - exact) < 4 * np.sqrt(exact / 4999)
    assert effect.change == pytest.approx(d.mean())
    reach = norm.isf(0.025) * d.std() / np.sqrt(12)
    assert (effect.low, effect.high) == pytest.approx((d.mean() - reach, d.mean() + reach))


def test_a_mean_difference_counts_trials_that_may_be_unseen():
    """None of 200 differs by other than 0.3: at most 1 - .025^(1/200) of all do, each by the
    largest there can be."""
    first = np.random.default_rng(5).standard_normal(200)
    effect = mean_effect(first, first + 0.3, 0.05, 8.0)
    reach = 8 * (1 - 0.025 ** (1 / 200))
    assert (effect.low, effect.high) == pytest.approx((0.3 - reach, 0.3 + reach), rel=1e-6)


@pytest.mark.parametrize(("others", "unseen"), [(1, True), (5, True), (6, False)])
def test_of_a_dozen_trials_half_have_to_differ_before_nothing_is_unseen(others, unseen):
    """Clopper and Pearson's upper limit of k in 12 has a chance of .025 of k or fewer."""
    first, second = np.zeros(12), np.where(np.arange(12) < others, np.arange(12) + 1.5, 1.0)
    effect = mean_effect(first, second, 0.05, 8.0)
    normal = norm.isf(0.025) * second.std() / np.sqrt(12)
    beyond = beta.isf(0.025, others + 1, 12 - others) - others / 12
    assert effect.high - second.mean() == pytest.approx(normal + unseen * 8 * beyond)


@pytest.mark.oracle("closed form: sum of binomial coefficients", "p of McNemar's test", 1e-9)
def test_success_is_mcnemar_s_test():
    """12 against 3 discordant trials: 2 (C(15,0) + ... + C(15,3)) / 2^15."""
    effect = success_effect(*successes(50, 3, 12, 5))
    assert_agrees(effect.p, 2 * (1 + 15 + 105 + 455) / 2**15, rtol=1e-9)
    assert effect.change == pytest.approx(9 / 70)


@pytest.mark.oracle(
    "library: SciPy's minimize_scalar of the likelihood",
    "score at the ends of an interval of a difference of success",
    1e-3,
)
@pytest.mark.parametrize("counts", [(50, 3, 12, 5), (20, 8, 1, 3), (10, 0, 4, 30), (5, 30, 40, 5)])
def test_the_ends_of_an_interval_of_success_have_the_score_of_the_quantile(counts):
    """At each end, the shares that are likeliest at that difference give a score of +-1.96: by
    maximising the likelihood numerically, which the closed form does not."""
    _, losses, gains, _ = counts
    effect, trials = success_effect(*successes(*counts)), sum(counts)

    def score(difference: float) -> float:
        def unlikely(lost: float) -> float:
            shares = np.array([lost, lost + difference, 1 - 2 * lost - difference])
            return -float(np.array([losses, gains, trials - losses - gains]) @ np.log(shares))

        bounds = (max(0.0, -difference) + 1e-12, (1 - difference) / 2 - 1e-12)
        lost = minimize_scalar(
            unlikely, bounds=bounds, method="bounded", options={"xatol": 1e-12}
        ).x
        return (gains - losses - trials * difference) / np.sqrt(
            trials * (2 * lost + difference - difference**2)
        )

    for end, side in ((effect.low, 1), (effect.high, -1)):
        if end != 0:
            assert_agrees(score(end), side * norm.isf(0.025), rtol=1e-3)


@pytest.mark.parametrize(("gains", "widened"), [(5, True), (6, False)])
def test_an_interval_of_success_holds_0_where_the_exact_test_does_not_reject(gains, widened):
    """Of 5 trials that differ, all to one side, the exact p is 2 / 32, of 6 it is 2 / 64; the score
    rejects both."""
    effect = success_effect(*successes(200, 0, gains, 0))
    assert effect.p == pytest.approx(2 / 2**gains)
    assert (effect.low == 0.0) == widened
    assert effect.low >= 0.0
    turned = success_effect(*successes(200, gains, 0, 0))
    assert (turned.high == 0.0) == widened


def test_no_trial_that_differs_is_no_evidence_and_a_p_of_1():
    effect = success_effect(*successes(40, 0, 0, 10))
    assert (effect.p, effect.e, effect.change) == (1.0, 1.0, 0.0)
    assert effect.low < 0 < effect.high


@pytest.mark.oracle("closed form: beta functions", "evidence after one and two tosses", 1e-9)
def test_evidence_against_a_fair_coin_in_closed_form():
    """After one toss 1, whatever it showed; after two equal ones 2 B(2.5, 0.5) / B(0.5, 0.5) 2 =
    3/2."""
    assert_agrees(fair_coin(1, 0), 1.0, rtol=1e-9)
    assert_agrees(fair_coin(2, 0), 1.5, rtol=1e-9)
    assert_agrees(fair_coin(1, 1), 0.5, rtol=1e-9)
    assert fair_coin(10**6, 0) < np.inf


def test_evidence_is_1_on_average_where_there_is_nothing():
    """An exact sum over all numbers of heads, and over all signs of given differences."""
    heads = np.arange(13)
    weights = np.array([len(list(itertools.combinations(range(12), k))) for k in heads]) / 2**12
    assert weights @ np.array([fair_coin(k, 12 - k) for k in heads]) == pytest.approx(1.0)
    sizes = np.array([0.1, 0.7, 1.0, 2.0, 0.4, 3.0])
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=6)))
    assert np.mean([no_lean(s * sizes, 0.4) for s in signs]) == pytest.approx(1.0)


def test_evidence_is_for_the_side_of_the_sum():
    """90 % of 400 trials are cheaper and 10 % so much dearer that the means are as good as equal: a
    sign test has e = 3e62 for the side that the means deny. Beyond 1, evidence speaks for the sign
    of the sum."""
    d = np.where(np.arange(400) % 10 > 0, -50.0, 460.0)
    assert no_lean(d, 150.0) < 1
    rng = np.random.default_rng(3)
    for _ in range(200):
        d = rng.normal(0, 1, 60) * rng.choice([1.0, 30.0], 60)
        assert no_lean(d - d.mean(), 1.0) <= 1
    assert no_lean(np.full(400, -50.0), 150.0) > 1e60


@pytest.mark.slow
def test_who_looks_after_every_trial_is_misled_no_more_often_than_promised():
    """1 / alpha is exceeded anywhere among 400 tosses in at most alpha of 300 sequences, up to 3
    deviations."""
    tosses = np.random.default_rng(0).integers(0, 2, (300, 400))
    heads = np.cumsum(tosses, axis=1)
    ever = [max(fair_coin(h, i + 1 - h) for i, h in enumerate(row)) >= 10 for row in heads.tolist()]
    assert np.mean(ever) < 0.1 + 3 * np.sqrt(0.1 * 0.9 / 300)
    steps = (2 * tosses - 1) * np.random.default_rng(1).uniform(size=(300, 400))
    misled = [max(no_lean(row[:k], 1.0) for k in range(10, 401, 10)) >= 10 for row in steps]
    assert np.mean(misled) < 0.1 + 3 * np.sqrt(0.1 * 0.9 / 300)
