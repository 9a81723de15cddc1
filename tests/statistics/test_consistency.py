"""NEES, limits and the verdict, against simulated truth and published values."""

import numpy as np
import pytest
from scipy.optimize import brentq
from shared.oracles import assert_agrees

from ipe_bench.statistics.intervals import mean_limits, mean_nees, verdict
from ipe_bench.trials.scoring import nees


def draw(trials: int, claimed: float = 1.0, seed: int = 0):
    """Errors of covariance A A', and a reported covariance that is `claimed` squared times that."""
    rng = np.random.default_rng(seed)
    A = np.array([[3.0, 0.0, 0.0], [1.0, 1e-4, 0.0], [0.5, 2e-4, 1e-6]])
    error = rng.standard_normal((trials, 3)) @ A.T
    return error, np.repeat(claimed**2 * (A @ A.T)[None], trials, axis=0)


@pytest.mark.oracle(
    "published: Bar-Shalom, Li and Kirubarajan, Estimation with Applications, example 5.4.2",
    "limits of NEES over 50 runs",
    5e-4,
)
def test_limits_are_those_of_the_textbook():
    """Bar-Shalom, Li, Kirubarajan, example 5.4.2: 50 runs of 2 degrees, [74.2, 129.6] / 50 for the
    sum over runs."""
    low, high = mean_limits(2, 50)
    assert_agrees(2 * low, 74.22 / 50, atol=5e-4)
    assert_agrees(2 * high, 129.56 / 50, atol=5e-4)


@pytest.mark.parametrize(
    ("claimed", "expected"),
    [(1.0, "consistent"), (1.5, "too cautious"), (0.8, "overconfident")],
)
def test_verdict(claimed, expected):
    values = nees(*draw(1000, claimed))
    assert verdict(values, 3) == expected
    assert values.mean() / 3 == pytest.approx(1 / claimed**2, rel=0.1)


def test_a_few_divergences_that_chance_does_not_explain_are_named():
    error, P = draw(1000)
    error[:30] *= 1e3
    assert verdict(nees(error, P), 3) == "overconfident"
    P[:30] *= 1e6  # the same errors, owned up to
    assert verdict(nees(error, P), 3) == "consistent"


def test_what_is_no_covariance_or_no_estimate():
    error, P = draw(20)
    P[0] = np.nan
    P[1] = -P[1]
    P[2] = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    P[3] = np.ones((3, 3))
    error[4] = np.nan
    values = nees(error, P)
    assert np.isnan(values[0])
    assert np.isinf(values[1:5]).all()
    assert np.isfinite(values[5:]).all()
    assert verdict(values, 3) == "-"  # one made no claim, and 19 are too few to judge
    # Of 20 claims four are beyond any gate.
    assert verdict(np.append(values, values[5]), 3) == "overconfident"


def test_nothing_claimed_nothing_judged():
    assert verdict(np.full(5, np.nan), 3) == "-"


# Errors of other laws -----------------------------------------------------------------------------


def normal(rng, shape):
    return rng.standard_normal(shape)


def student(rng, shape):
    """Five degrees of freedom, of variance 1."""
    return rng.standard_t(5, shape) * np.sqrt(3 / 5)


def contaminated(rng, shape):
    """One error in twenty is ten times larger; of variance 1."""
    return (
        np.where(rng.random(shape) < 0.05, 10.0, 1.0)
        * rng.standard_normal(shape)
        / np.sqrt(0.95 + 5)
    )


def verdicts(
    noise, n: int, m: int, trials: int, studies: int, claimed: float = 1.0
) -> dict[str, float]:
    """How often each verdict is given on n parameters estimated from m readings with errors of that
    law, when the reported standard deviations are `claimed` times the true ones."""
    rng = np.random.default_rng([n, m, trials])
    found = []
    for _ in range(studies):
        Q, _ = np.linalg.qr(rng.standard_normal((m, n)))
        values = np.sum((noise(rng, (trials, m)) @ Q) ** 2, axis=1) / claimed**2
        found.append(verdict(values, n))
    return {word: found.count(word) / studies for word in set(found)}


def nees_misses(noise, n: int, trials: int, studies: int) -> float:
    """How often the interval of the mean NEES does not hold 1, which it is; of a law with errors
    that are ten times larger, in studies that show three of them."""
    rng = np.random.default_rng([n, trials, 5])
    held = []
    while len(held) < studies:
        size = np.ones(trials)
        if noise is contaminated:
            size = np.where(rng.random(trials) < 0.05, 10.0, 1.0) / np.sqrt(0.95 + 5)
        if noise is student:
            size = np.sqrt(3 / rng.chisquare(5, trials))
        if noise is contaminated and (size > 1).sum() < 3:
            continue
        found = mean_nees(size**2 * rng.chisquare(n, trials), n)
        held.append(found.low <= 1 <= found.high)
    return 1 - float(np.mean(held))


@pytest.mark.parametrize("noise", [normal, student, contaminated])
def test_the_interval_of_the_mean_nees_holds_it_whatever_the_law_of_errors_that_are_seen(noise):
    assert nees_misses(noise, 3, 40, 150) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 150)


@pytest.mark.slow
@pytest.mark.parametrize("trials", [40, 100, 200])
@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("noise", [normal, student, contaminated])
def test_1000_intervals_of_the_mean_nees_hold_it(noise, n, trials):
    share = nees_misses(noise, n, trials, 1000)
    print(f"{noise.__name__}, n {n}, {trials} trials: missed {share:.1%}")
    assert share <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 1000)


def false_alarms(found: dict[str, float]) -> float:
    return sum(found.get(word, 0.0) for word in ("overconfident", "too cautious"))


@pytest.mark.parametrize("noise", [normal, student, contaminated])
def test_an_honest_covariance_is_seldom_called_otherwise_whatever_the_law_of_the_noise(noise):
    """Chi-square limits, which are of normal errors, alarm in .40 of these where the noise has
    outliers."""
    found = verdicts(noise, 1, 6, 100, 150)
    assert false_alarms(found) <= 0.07 + 2 * np.sqrt(0.07 * 0.93 / 150)


@pytest.mark.parametrize(
    ("claimed", "word", "trials"), [(0.7, "overconfident", 100), (1 / 0.7, "too cautious", 500)]
)
def test_a_deviation_30_per_cent_off_is_found(claimed, word, trials):
    assert verdicts(normal, 3, 6, trials, 40, claimed)[word] >= 0.9


def test_a_covariance_that_is_right_on_average_is_not_called_overconfident():
    """3 % of 400 trials lie beyond the gate, at 6 n, and the mean of NEES / n is 1."""
    values = np.full(400, 11 * (1 - 0.03 * 6) / 0.97)
    values[:12] = 66.0
    assert values.mean() / 11 == pytest.approx(1.0)
    assert verdict(values, 11) != "overconfident"
    values[:12] = 6600.0
    assert verdict(values, 11) == "overconfident"


@pytest.mark.parametrize(("trials", "word"), [(145, "undecided"), (146, "too cautious")])
def test_small_errors_of_few_trials_are_no_sure_sign_of_caution(trials, word):
    """In 145 trials, with a probability of .05, none is seen of a share 1 - .05^(1/145) = .02045; a
    NEES of 50 n there, 49 n more than efficient errors have, makes up a mean of 1.002 n, and of 146
    trials one of .995 n."""
    assert verdict(np.full(trials, 1e-9), 1) == word


@pytest.mark.parametrize("n", [1, 4, 11])
@pytest.mark.parametrize(("share", "times"), [(0.01, 10.0), (0.02, 1e4), (0.05, 10.0)])
def test_a_right_covariance_is_seldom_called_too_cautious_by_trials_without_their_outliers(
    n, share, times
):
    """Of 60 trials .55 show none of the errors that one in a hundred has, and their mean NEES is
    half of n."""
    rng = np.random.default_rng(n)
    for trials in (60, 200):
        squares = rng.chisquare(n, (100, trials)) * np.where(
            rng.random((100, trials)) < share, times**2, 1.0
        )
        found = [verdict(x / (1 - share + share * times**2), n) for x in squares]
        assert found.count("too cautious") <= 7


@pytest.mark.parametrize(
    ("times", "word"), [(21, "undecided"), (39, "undecided"), (41, "overconfident")]
)
def test_a_mean_above_1_that_few_trials_carry_is_sure_where_bets_on_it_win_40_times_their_stake(
    times, word
):
    """Ville: they win as much in at most 1 / 40, which is the half of 5 % that one side of 1 has. 1
    - 2^-k of the stake .99 is kept back."""

    def fortune(size: float) -> float:
        x = np.append(np.full(196, 0.5), np.full(4, size))
        return float(np.mean([np.prod(1 + 0.99 * 0.5**k * (x - 1)) for k in range(9)]))

    size = brentq(lambda size: fortune(size) - times, 10, 1000)
    assert verdict(np.append(np.full(196, 0.5), np.full(4, size)), 1) == word


def test_where_few_trials_carry_the_mean_only_too_large_a_mean_is_sure():
    """Markov: numbers of mean 1 exceed 40 with a probability of at most 1 / 40, whatever else they
    are."""
    few = np.full(200, 0.5)
    few[0] = 200 * 1.0 - 99.5  # the mean is 1
    assert verdict(few, 1) == "undecided"
    assert verdict(np.full(400, 0.5), 1) == "too cautious"
    error, P = draw(200)
    error[:2] *= 40
    assert verdict(nees(error, P), 3) == "overconfident"


@pytest.mark.campaign
@pytest.mark.parametrize("trials", [20, 50, 100, 400])
@pytest.mark.parametrize(("n", "m"), [(1, 6), (3, 20), (11, 40)])
@pytest.mark.parametrize("noise", [normal, student, contaminated])
def test_1000_honest_studies_have_few_false_alarms(noise, n, m, trials):
    found, low = (
        verdicts(noise, n, m, trials, 1000 if claimed == 1 else 300, claimed)
        for claimed in (1.0, 0.7)
    )
    print(f"{noise.__name__}, n {n}, m {m}, {trials} trials: {found}; 30 % too small: {low}")
    assert false_alarms(found) <= 0.07 + 2 * np.sqrt(0.07 * 0.93 / 1000)
    if trials >= 100 and noise is not contaminated:
        assert low.get("overconfident", 0) >= 0.9


def test_a_variance_of_1_5_times_the_reported_is_seldom_called_consistent():
    """Of 40 trials of four parameters, at the level that eleven estimators share."""
    rng = np.random.default_rng(3)
    level = 1 - 0.05 / 11
    found = [verdict(1.5 * rng.chisquare(4, 40), 4, level) for _ in range(60)]
    assert found.count("consistent") <= 3
    right = [verdict(rng.chisquare(4, 100), 4, level) for _ in range(30)]
    assert right.count("consistent") >= 25
